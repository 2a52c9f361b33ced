"""Names by shell pattern."""

import pytest

from egoskin.hints import matching

LINKS = ("torso_link", "left_elbow_link", "right_elbow_link", "pad[0]", "pad0")


@pytest.mark.parametrize(
    ("patterns", "found"),
    [
        (["*_elbow_*"], ("left_elbow_link", "right_elbow_link")),
        # In the order of the patterns, each name once.
        (
            ["right_*", "torso_link", "*elbow*"],
            ("right_elbow_link", "torso_link", "left_elbow_link"),
        ),
        # As a pattern, "pad[0]" would be "pad0".
        (["pad[0]"], ("pad[0]",)),
        (["Torso_link", "torso*"], None),
        ([], ()),
    ],
)
def test_names_and_patterns(patterns, found):
    if found is not None:
        assert matching(patterns, LINKS, "link") == found
        return
    with pytest.raises(
        ValueError,
        match=r"no link 'Torso_link', did you mean 'torso_link'\? \(links: torso",
    ):
        matching(patterns, LINKS, "link")


def test_a_text_in_place_of_a_sequence_is_refused():
    with pytest.raises(ValueError, match=r"a sequence of links, got 'torso\*'"):
        matching("torso*", LINKS, "link")
