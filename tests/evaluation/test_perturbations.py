"""Success on perturbed robots: what is reported is what was played."""

from __future__ import annotations

import re
from dataclasses import asdict, replace

from egoskin.envs.randomization import RandomizationConfig
from egoskin.evaluation import perturbations
from egoskin.evaluation.perturbations import PERTURBATIONS, Perturbed, perturb
from egoskin.evaluation.throw_set import play_throws, standard_task, summarize
from egoskin.policies.policy import load_policy


def test_the_last_perturbation_is_of_all_others_together():
    none, *alone, together = map(asdict, PERTURBATIONS.values())
    assert none == asdict(RandomizationConfig())
    for ranges in alone:
        assert ranges != none
        for name in (name for name in ranges if ranges[name] != none[name]):
            (low, high), (least, most) = ranges[name], together[name]
            assert least <= low <= high <= most


def test_a_perturbation_is_as_large_as_its_name_says():
    none = asdict(RandomizationConfig())
    steps = {"actions a step late": (1, 1), "actions two steps late": (2, 2)}
    for name, perturbed in list(PERTURBATIONS.items())[1:]:
        said = tuple(map(float, re.findall(r"[\d.]+", name)))
        ranges = asdict(perturbed)
        changed = [ranges[key] for key in ranges if ranges[key] != none[key]]
        assert steps.get(name, said) in changed, name
        # Pushes have a time, the default; the last one is all of them.
        assert len(changed) == 1 or name.startswith("all")


def test_each_perturbation_is_played_and_so_is_the_mask(monkeypatch):
    names = ("none", "gains 0.8 to 1.2", "actions two steps late")
    some = {name: PERTURBATIONS[name] for name in names}
    monkeypatch.setattr(perturbations, "PERTURBATIONS", some)
    policy = load_policy("field_proximity")
    config = standard_task(policy.env_config)
    task = replace(config.task, success_s=2.0, episode_length_s=2.0)
    which = {"throw_set": 0, "episodes": 12}

    def played(
        name: str, ranges: RandomizationConfig, mask: tuple[str, ...]
    ) -> Perturbed:
        own = replace(task, randomization=ranges)
        subject = policy, replace(config, task=own), policy.skin
        episodes = play_throws(*subject, mask=mask, **which)
        result = summarize(episodes, episodes, own)
        return Perturbed(
            name=name,
            success=result.success,
            success_5s=result.success_5s,
            ended_by_fall=result.ended_by_fall,
        )

    mask = ("torso_link",)
    # The configuration's own randomization, masses, is replaced.
    heavy = replace(task, randomization=RandomizationConfig(link_mass=(2.0, 2.0)))
    subject = policy, replace(config, task=heavy), policy.skin
    found = perturb(*subject, mask=mask, **which)
    assert found == [played(name, PERTURBATIONS[name], mask) for name in names]
    # They are not the same by chance.
    assert len({row.success.mean for row in found}) == 3
    unmasked = played("none", PERTURBATIONS["none"], ())
    assert unmasked.success.mean > found[0].success.mean
