"""egoskin: which proximity skin makes avoidance easy to learn?

TensorDict keys, grouped by their writer. ``*B`` batch, ``J`` joints, ``L`` links, ``O``
objects, ``S`` sensors; suffix ``_w`` world frame, ``_b`` base frame; unit
quaternions (w, x, y, z).

=========================== ============== ============================= ==============
key                         shape          content                       read by
=========================== ============== ============================= ==============
from `egoskin.envs.dodgeball.DodgeballEnv` (all keys: see its docstring)
---------------------------------------------------------------------------------------
``base_pose``               ``[*B, 7]``    pose in the world [m]         sensors
``joint_pos``               ``[*B, J]``    hinges [rad], slides [m]      sensors
``object_pose``             ``[*B, O, 7]`` pose in the world [m]         sensors
``object_active``           ``[*B, O]``    bool: in play                 sensors
``tactile``                 ``[*B, L]``    bool: link touched something  tactile
``reward``, ``done``, ...   ``[*B, 1]``    TorchRL's                     PPO
from `egoskin.sensors.FieldSensor` or ``RaySensor``
---------------------------------------------------------------------------------------
``distance``                ``[*B, S]``    or ``[*B, S, K]`` [m]; or inf signals
``object_detected``         ``[*B, O]``    bool: by any sensor           signals
from `egoskin.sensors.imperfections.corruption.Corruption`
---------------------------------------------------------------------------------------
``reading``                 as distance    with sensor imperfections     signals
``reading_clock``           ``[*B, 2]``    episode, step                 itself
``reading_i_*``             any            state of an imperfection      itself
from `egoskin.sensors.Proximity`, ``Binary`` or ``Localization``
---------------------------------------------------------------------------------------
``signal``                  ``[*B, S K]``  or ``[*B, 3]`` (localization) actor, critic
from `egoskin.sensors.history` (`make_env` writes them as ``signal``, ``observation``)
---------------------------------------------------------------------------------------
``last_signal``             as signal      last one with a detection     actor, critic
``signal_history``          ``[*B, ...]``  the latest signals            actor, critic
from `egoskin.sensors.tactile`, in custom tasks
---------------------------------------------------------------------------------------
``contact_force``           ``[*B, L, 3]`` from your task [N]            tactile
``contact_free``            ``[*B, 1]``    bool: no contact so far       your task
from `egoskin.envs.observations`
---------------------------------------------------------------------------------------
``observation``             ``[*B, 6+2J]`` body; 6+3J with last action   actor, critic
``privileged_observation``  ``[*B, P]``    observed in training only     critic
``signal``                  ``[*B, 7 O]``  oracle: true ball states      actor, critic
from `egoskin.agents.networks.Agent`
---------------------------------------------------------------------------------------
``action``                  ``[*B, J]``    see DodgeballEnv              env
``action_log_prob``         ``[*B]``       of the action                 PPO
``loc``, ``scale``          ``[*B, J]``    of the action's Gaussian      PPO
``state_value``             ``[*B, 1]``    value of the state            PPO
=========================== ============== ============================= ==============
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

# By default, idle torch threads busy-wait and take cores from other processes; on a
# loaded machine an update then takes many times as long. OpenMP reads these variables
# when torch is first imported, so import egoskin first. Values already set are kept.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

if TYPE_CHECKING:
    from egoskin.evaluation.throw_set import evaluate, standard_task
    from egoskin.make import EnvConfig, make_env, make_worker_env
    from egoskin.policies.policy import Policy, load_policy

__version__ = "0.1.0"

_EXPORTS = {
    "EnvConfig": "egoskin.make",
    "evaluate": "egoskin.evaluation.throw_set",
    "make_env": "egoskin.make",
    "make_worker_env": "egoskin.make",
    "Policy": "egoskin.policies.policy",
    "load_policy": "egoskin.policies.policy",
    "standard_task": "egoskin.evaluation.throw_set",
}

__all__ = [
    "EnvConfig",
    "Policy",
    "evaluate",
    "load_policy",
    "make_env",
    "make_worker_env",
    "standard_task",
]


def __getattr__(name: str) -> Any:
    """Return a public name; its module is imported on first access."""
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    """Return the names of the module, including those not yet imported."""
    return sorted({*globals(), *_EXPORTS})
