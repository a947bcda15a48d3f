"""The options of ``histmv eval`` and how its command line is read."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

from dataset_tools import command_line
from dataset_tools.eval_checkpoint import PolicySource

REPORTED_SEEDS = 200_000
"""First seed of reported evaluations: neither recordings nor evaluations during training use seeds from here on."""


@dataclass(kw_only=True)
class PolicyCommand:
    """Options of a command that runs a policy."""

    policy: PolicySource = field(default_factory=PolicySource)

    @classmethod
    def parse(cls, args: Sequence[str], prog: str) -> "PolicyCommand":
        """The configuration that a command line describes; ``--policy.NAME=`` sets any option of the policy."""
        register_third_party_plugins()
        arguments = list(args)
        if {"-h", "--help"} & set(arguments):
            sys.argv[0] = prog  # what the usage line names
            parser.print_scoped_help(cls, arguments)
            sys.exit(0)
        path = parser.get_path_arg("policy", arguments)
        overrides = parser.get_cli_overrides("policy", arguments) or []
        config: PolicyCommand = command_line.parse(cls, parser.filter_path_args("policy", arguments), prog)
        config.policy = PolicySource(path or config.policy.path, [*config.policy.overrides, *overrides])
        return config


@dataclass
class ScenesConfig:
    """How many scenes, and how many at a time."""

    # unseen scenes per task
    n_episodes: int = 100
    # scenes simulated side by side; 0: one per CPU core
    batch_size: int = 0
    # simulate them in processes of their own
    use_async_envs: bool = True


@dataclass
class EvaluateConfig(PolicyCommand):
    """Evaluate a checkpoint: histmv eval --policy.path=CHECKPOINT --env.type=ur5 --env.task=pick_and_lift."""

    # the environment: --env.type=ur5 and its options, such as --env.task=reach_target,pick_and_lift
    env: EnvConfig
    eval: ScenesConfig = field(default_factory=ScenesConfig)
    # seed of the first scene, the others follow; recordings use seeds below 100000, training evaluates below 200000
    seed: int = REPORTED_SEEDS
    # episodes per task to film, the first ones; a filmed episode takes several times as long
    videos: int = 10
    # where the results go; what an earlier run left there for the same checkpoint and settings is kept and completed
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        for name, value, least in (
            ("eval.n_episodes", self.eval.n_episodes, 1),
            ("eval.batch_size", self.eval.batch_size, 0),
            ("videos", self.videos, 0),
            ("seed", self.seed, 0),
        ):
            if value < least:
                raise ValueError(f"{name}={value} must be at least {least}")
