"""``histmv explain``: why a policy acted as it did, decision by decision, as a film, pictures and one page."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from lerobot.envs.configs import EnvConfig
from rich.console import Console
from rich.progress import Progress

from dataset_tools.eval_checkpoint import check_fits, load_config
from dataset_tools.eval_settings import REPORTED_SEEDS, PolicyCommand
from dataset_tools.explain.chapter import FILM, PANELS, SHEET, chapter
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.sheet import draw_sheet
from dataset_tools.explain.sources import explain_dataset, explain_rollout, open_keyframes
from dataset_tools.page import Exhibit, draw_panels, page
from dataset_tools.published import check_free, published
from lerobot_histmv.configuration_histmv import HistMVConfig

PAGE = "explanation.html"
OUTPUTS = Path("outputs/explain")


@dataclass
class ExplainedDataset:
    """A keyframed dataset, for an episode whose true poses are known."""

    # name, such as user/keyframes
    repo_id: str = ""
    # folder that holds it
    root: Path | None = None
    # branch, tag or commit on the Hub
    revision: str | None = None


@dataclass
class ExplainConfig(PolicyCommand):
    """Show what a policy looked at: heat maps, view weights, shared information, attention over steps, poses.

        histmv explain --policy.path=CHECKPOINT --dataset.repo_id=me/keys --dataset.root=data/keys --episode=3
        histmv explain --policy.path=CHECKPOINT --env.type=ur5 --env.task=stack_blocks.two-red --seed=200000

    writes a film, PNG files and explanation.html, which holds all of them.
    """

    # either: an episode of a keyframed dataset, at each of whose rows the policy decides
    dataset: ExplainedDataset = field(default_factory=ExplainedDataset)
    # episode of the dataset
    episode: int = 0
    # or: an environment in which the policy acts, as for histmv eval
    env: EnvConfig | None = None
    # scene of the environment
    seed: int = REPORTED_SEEDS
    # folder to write; by default outputs/explain/NAME_NUMBER
    output: Path | None = None
    # replace an existing output folder
    overwrite: bool = False

    def __post_init__(self) -> None:
        if bool(self.dataset.repo_id) == (self.env is not None):
            raise ValueError(
                "explain needs one source of an episode: --dataset.repo_id=me/keys --episode=N, or "
                "--env.type=ur5 --env.task=TASK --seed=N"
            )

    @property
    def task(self) -> str:
        """The environment's task; empty for a dataset."""
        return "" if self.env is None else str(self.env.task)

    @property
    def place(self) -> Path:
        """The folder to write, as an absolute path."""
        name = f"{self.task}_{self.seed}" if self.task else f"{Path(self.dataset.repo_id).name}_{self.episode}"
        return (self.output or OUTPUTS / name).expanduser().resolve()


def run(config: ExplainConfig) -> None:
    """Let the policy decide, draw, write. Nothing appears at the output before all of it is done.

    Raises:
        ValueError: the checkpoint, the source or the output place is not as it must be; see ``sources``.
    """
    console = Console(highlight=False)
    root = config.place
    check_free(root, config.overwrite, PAGE)
    decide = explainer(config)
    with published(root, config.overwrite, PAGE) as partial_root, Progress(console=console) as progress:
        bar = progress.add_task("deciding and filming", total=2)
        film = partial_root / "film.mp4"
        episode = decide(film)
        progress.update(bar, advance=1, description="drawing")
        one = chapter(episode, draw(episode, film))
        about = f"policy {config.policy.path}; {config.dataset.repo_id or config.task}"
        (partial_root / PAGE).write_text(page("What the policy looked at", about, [one]), encoding="utf-8")
        progress.update(bar, advance=1)
    console.print(f"{one.name}: {one.facts}", soft_wrap=True, markup=False)
    console.print(f"written to {root}: open {root / PAGE}", soft_wrap=True, markup=False)


def explainer(config: ExplainConfig) -> Callable[[Path], Explained]:
    """What lets the policy decide and writes the film to a path; checkpoint and source are known to fit."""
    policy = load_config(config.policy)
    if not isinstance(policy, HistMVConfig):
        raise ValueError(f"{config.policy.path} is a policy of type {policy.type}; explain looks inside histmv ones")
    if policy.network.views.fusion != "attention":
        raise ValueError(
            f"{config.policy.path} has views.fusion={policy.network.views.fusion!r}; explain shows how the views were "
            "weighed, which only views.fusion='attention' does"
        )
    if config.env is not None:
        check_fits(policy, config.env)
        return partial(explain_rollout, policy, config.env, config.seed)
    told = config.dataset
    return partial(
        explain_dataset, policy, open_keyframes(policy, told.repo_id, told.root, config.episode, told.revision)
    )


def draw(episode: Explained, film: Path) -> list[Exhibit]:
    """Write all pictures beside the ``film``; everything to show, in order."""
    sheet = film.with_name("decisions.png")
    draw_sheet(episode).save(sheet)
    return [Exhibit(*FILM, film), *draw_panels(PANELS, episode, film.parent, "episode"), Exhibit(*SHEET, sheet)]
