"""Short help page of each command: common options, and examples.

They are fixed texts, because the options themselves are known only after seconds of
imports; tests compare them with `--help-all`. Values in parentheses are defaults.
"""

from __future__ import annotations

PAGES = {
    "train": """\
Train a robot to dodge balls with a skin of proximity sensors.

  --sensor.coverage {field,ray,none,oracle}
                          a sphere around each sensor; an 8x8 grid of beams; no
                          skin; the balls' true states (field)
  --sensor.signal {localization,proximity,closeness,binary}
                          where a ball is; distance / range; 1 - that; whether one
                          is in range (proximity)
  --sensor.range FLOAT    to the ball's surface [m] (2.0)
  --skin.path PATH        skin file, see egoskin skin; else 64 random sensors
  --robot NAME|PATH       h1_2, g1, or your own: a folder with robot.toml, or
                          my_robot.py:ROBOT (h1_2)
  --standard {2,1,paper}  version of the throws; see docs/standard-throw.md
  --seed INT              seed of all random numbers (0)
  --total-frames INT      environment steps of the whole run (65536000)
  --run-dir PATH          folder of the run; else a new one under runs/
  --resume PATH           run folder to resume, bit for bit

  egoskin train --sensor.signal binary --sensor.range 1 --seed 1
  egoskin train --resume runs/NAME --total-frames 100e6
  egoskin train --config runs/NAME/config.json --seed 2
  egoskin train --init-from localization --sensor.signal localization \\
      --task.randomization.friction 0.4 1
  egoskin train --film-every 5e6 --log wandb
  egoskin train --engine warp --device cuda
""",
    "evaluate": """\
Evaluate a policy on a fixed set of held-out throws.

  POLICY                  run folder, checkpoint, policy file, or a policy of the
                          package: field_proximity, localization, field_binary,
                          blind, g1_proximity
  --episodes INT          throw sequences (1024)
  --throw-set INT         seed of the throw set (0)
  --standard {2,1,paper,run}
                          version of the throws (2)
  --mask [LINK ...]       links whose sensors detect nothing; alone: all sensors
  --behaviour             also hits by kind of throw, displacement, effort
  --perturbed             also with other masses, friction, gains, delays, pushes
  --map PATH              picture of success against speed, interval, height, direction
  --check-substeps INT    also with finer physics (8: 480 Hz)
  --json PATH             JSON file to write the results to

  egoskin evaluate field_proximity --episodes 256
  egoskin evaluate runs/NAME --mask
  egoskin evaluate runs/NAME --behaviour --map map.png
""",
    "view": """\
See a policy in the browser, and throw balls at it; or a skin, or a robot.

  POLICY ...              run folder (followed while it trains), checkpoint, policy
                          file, or a policy of the package; two are shown side by side
  --skin PATH             a skin file on its robot, without a policy
  --robot NAME|PATH       a robot without a policy: h1_2, g1, a folder with robot.toml,
                          my_robot.py:ROBOT, or an MJCF or URDF file
  --port INT              local port, on 127.0.0.1; 0: any free port (8080)

  egoskin view field_proximity
  egoskin view runs/NAME runs/OTHER
  egoskin view --skin my.json
""",
    "film": """\
Film an episode of a policy, with a contact sheet of its moments.

  POLICY                  run folder, checkpoint, policy file, or a policy of the
                          package; none: zero action, targets at the default pose
  --hold                  hold the robot rigid in its default pose
  --out PATH              film to write, .mp4 or .gif (episode.mp4)
  --longest-of INT        film the longest of this many episodes (1)
  --episode INT           index of the episode in the throw set (0)
  --throw-set INT         seed of the throw set (0)
  --standard {2,1,paper,run}
                          version of the throws (2)
  --seconds FLOAT         stop at this age at the latest [s]
  --slowdown FLOAT        times slower than real time (1.0)
  --size INT INT          width and height [px] (960 540)
  --camera.azimuth-deg FLOAT
                          bearing of the camera from the robot's heading [deg] (30.0)

  egoskin film field_proximity --longest-of 16 --out dodge.mp4
  egoskin film runs/NAME --episode 3 --slowdown 4
""",
    "skin": """\
Place, import, export and show skins.

  egoskin skin place --method poisson_disk --num-sensors 48 --out my.json
                          sensors spread over a robot's surface
  egoskin skin import shell.csv --out my.json
                          a skin file from GenTact's exports (CSV, xacro, URDF)
  egoskin skin export my.json --out my.csv
                          a skin file as GenTact's CSV
  egoskin skin show my.json --picture my.png
                          what is in a skin file, and its picture

egoskin skin place --help lists the options of place; likewise for the others.
""",
    "robot": """\
Check a robot before training; docs/your-robot.md says how to bring your own.

  egoskin robot check my_robot --out robot.png
                          check gains, limits, feet and skin, and whether it
                          stands; draw the robot with its skin

A robot is h1_2, g1, a folder with robot.toml, or my_robot.py:ROBOT. egoskin robot check
--help lists the options of check.
""",
    "visibility": """\
Show what a skin sees of the throws; no training is needed.

  --skin.path PATH        skin file; else 64 random sensors
  --skin.num-sensors INT  number of sensors to place (64)
  --robot NAME|PATH       the robot (h1_2)
  --coverages {field,ray} ...
                          coverages compared (field ray)
  --ranges FLOAT ...      ranges compared [m] (0.2 0.5 1.0 2.0)
  --occlusion             the robot's own body hides what lies behind it
  --num-throws INT        number of throws (2000)
  --seed INT              of the throws and of the points on the surface (0)
  --out PATH              picture to write (visibility.png)
  --json PATH             JSON file to write all results to (visibility.json)

  egoskin visibility --skin.path my.json --out my.png
  egoskin visibility --ranges 0.5 1 --occlusion
""",
    "upper-bound": """\
Search for actions that avoid a ball once it is near a sensor: what the robot is able
to do, as a reference for a policy.

  POLICY                  run folder, checkpoint, policy file, or a policy of the
                          package: it plays until the search takes over
  --throws INT            episodes of the throw set (32)
  --throw-set INT         seed of the throw set (0)
  --ball INT              which ball of each episode (1)
  --reach FLOAT           distance from a sensor at which the search starts [m] (2.0)
  --search.samples INT    plans tried in each iteration (128)
  --search.iterations INT iterations of the search (20)
  --search.seed INT       seed of the plans drawn (0)
  --json PATH             JSON file to write the results to

  egoskin upper-bound field_proximity --ball 2
""",
    "replay": """\
Repeat a training update whose result was NaN or infinite.

  FILE                    what a training wrote: runs/NAME/not-finite-*.safetensors

  egoskin replay runs/NAME/not-finite-000001048576.safetensors
""",
    "study": """\
Run a study: trainings that differ in a few fields, over several seeds.

  egoskin study plan findings --dir studies/findings
                          print its cost; write the manifest
  egoskin study run findings --dir studies/findings
                          run or resume it; runners may share a folder
  egoskin study status studies/findings
                          its progress, from the folder alone
  egoskin study report studies/findings
                          report.md, index.html, runs.csv and the figures
  egoskin study slurm studies/findings > study.sh
                          a job array for Slurm
  egoskin study adopt studies/findings runs/NAME
                          add an existing run

A study is paper, paper-1000, findings, smoke, or a JSON file. egoskin study run --help
lists the options of run; likewise for the others.
""",
    "export": """\
Write a policy as ONNX, for a robot without PyTorch; docs/deploy.md says how to run it.

  POLICY                  run folder, checkpoint, policy file, or a policy of the
                          package
  --out PATH              file to write
  --to {onnx}             format (onnx)

  egoskin export field_proximity --out policy.onnx
""",
    "verify": """\
Check that training is reproducible on this machine: a resume, other numbers of workers
and threads, and other kernels give the same bits.

  --iterations INT        rollouts to train; a resume is tried after half (6)
  --num-envs INT          agents, a multiple of 4 (4096)
  --seed INT              of the trainings (0)

  egoskin verify --iterations 4
  egoskin verify --iterations 2 --num-envs 256 --sensor.coverage ray
""",
    "bench": """\
Measure speed and accuracy.

  egoskin bench loop      the training loop, layer by layer [steps/s]
  egoskin bench physics   the physics, for variants of the robot's model
  egoskin bench engine    MuJoCo Warp, for several numbers of worlds
  egoskin bench sensors   the sensor kernels
  egoskin bench accuracy  the physics against a finer rate
  egoskin bench gradients --run runs/NAME
                          the actor's gradients of several rollouts, compared
  egoskin bench gymnasium the Gymnasium interfaces of the environment

egoskin bench loop --help lists the options of loop; likewise for the others.
""",
}
"""Text by command."""
WITH_SUBCOMMANDS = ("skin", "robot", "study", "bench")
"""Commands whose first argument is a subcommand."""
ARGUMENTS = {
    "evaluate": "POLICY",
    "view": "[POLICY ...]",
    "film": "[POLICY]",
    "upper-bound": "POLICY",
    "replay": "FILE",
    "export": "POLICY --out PATH",
}
"""Positional and required arguments by command."""


def page(name: str) -> str:
    """Return the short help page of a command."""
    if name in WITH_SUBCOMMANDS:
        return f"usage: egoskin {name} COMMAND [OPTIONS]\n\n{PAGES[name].rstrip()}"
    words = " ".join(filter(None, (name, ARGUMENTS.get(name), "[OPTIONS]")))
    return (
        f"usage: egoskin {words}\n\n{PAGES[name]}\n"
        f"All options: egoskin {name} --help-all"
    )


def asked_for(name: str, args: list[str]) -> bool:
    """Return whether the arguments of a command request its short help page."""
    help_asked = args[:1] if name in WITH_SUBCOMMANDS else args
    return not {"-h", "--help"}.isdisjoint(help_asked)
