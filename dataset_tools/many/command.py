"""``histmv keyframe-many``: a large dataset, keyframed in pieces by as many machines as there are."""

import json
import shutil
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dataset_tools.build import default_root
from dataset_tools.columns import ColumnsConfig
from dataset_tools.demonstrations import Demonstrations, understand
from dataset_tools.keyframe import KeyframeConfig, check_request, settings_of
from dataset_tools.many.merge import MergePieces
from dataset_tools.many.pieces import KeyframePiece
from dataset_tools.shards import write_json
from dataset_tools.source import open_source
from dataset_tools.workplace import Workplace

if TYPE_CHECKING:
    from datatrove.executor import SlurmPipelineExecutor

Engine = Literal["local", "slurm"]
"""Has a name because draccus finds no comment of an option whose annotation holds quotes."""
SETTINGS = "settings.json"


@dataclass
class SlurmConfig:
    """What the jobs on a Slurm cluster are submitted with."""

    # Partition; needed.
    partition: str = ""
    # Quality of service, if the cluster wants one.
    qos: str = ""
    # Longest time of one piece.
    time: str = "02:00:00"
    # Memory of one piece [GB].
    memory: int = 4


@dataclass
class KeyframeManyConfig(KeyframeConfig):
    """Keyframe a large dataset in pieces, several at a time, here or on a Slurm cluster.

        histmv keyframe-many --dataset.repo_id=me/demos --dataset.root=demos --output.repo_id=me/keys --output.root=keys
        histmv keyframe-many ... --pieces=1000 --engine=slurm --slurm.partition=cpu

    The rows are those of histmv keyframe with the same options, whatever the number of pieces. Finished pieces stay:
    the same command goes on with the others. Each is a LeRobot dataset; the last task merges them with LeRobot's own
    aggregation. Needs datatrove: pip install "lerobot_policy_histmv[scale]".
    """

    # Into how many pieces the episodes are split, at most one per episode.
    pieces: int = 8
    # local: --workers pieces at a time on this machine. slurm: one job per piece, on machines that see the same files.
    engine: Engine = "local"
    slurm: SlurmConfig = field(default_factory=SlurmConfig)


def run(config: KeyframeManyConfig) -> None:
    """Check, split, hand to the engine.

    Raises:
        ValueError: see ``keyframe.keyframe_dataset``; or the engine is not installed, or lacks an option.
    """
    executors = engine_module()
    root = (config.output.root or default_root(config.output.repo_id)).expanduser().resolve()
    told = config.dataset
    source = open_source(told.repo_id, told.root, told.episodes, told.revision)
    check_request(config, source, root)
    if config.pieces < 1:
        raise ValueError(f"pieces is {config.pieces}; it must be at least 1")
    count = min(config.pieces, len(source.episodes))
    if config.engine == "slurm" and not config.slurm.partition:
        raise ValueError("slurm.partition is empty; name the partition that the jobs go to")
    Workplace(root, {}, config.overwrite, "keyframed").check_free()
    whole = fully_told(config, understand(source, config.columns))
    demonstrations = understand(source, whole.columns)
    settings = settings_of(whole, source)
    folder = opened_pieces(root, {**settings, "pieces": count}, config.overwrite)
    work = KeyframePiece(whole, source.episodes, folder)
    notices = tuple(demonstrations.notices())
    merge = MergePieces(whole, settings, demonstrations.columns, notices, folder, count, root)
    if config.engine == "local":
        logs = str(folder / "logs")
        executors.LocalPipelineExecutor([work], count, config.workers, logs, skip_completed=False).run()
        merge()
    else:
        submit(executors.SlurmPipelineExecutor, config, work, merge)


def engine_module() -> Any:
    """Datatrove's executors; ValueError if it is not installed."""
    try:
        from datatrove import executor
    except ImportError as error:
        raise ValueError('keyframe-many needs datatrove: pip install "lerobot_policy_histmv[scale]"') from error
    return executor


def fully_told(config: KeyframeManyConfig, demonstrations: Demonstrations) -> KeyframeConfig:
    """The options, with what is otherwise found out from all episodes: a piece sees only its own."""
    columns: ColumnsConfig = config.columns
    if demonstrations.columns.gripper is not None:
        columns = replace(columns, gripper_range=list(demonstrations.ends))
    if demonstrations.columns.opening_range is not None:
        columns = replace(columns, opening_range=list(demonstrations.columns.opening_range))
    names = {name: getattr(config, name) for name in KeyframeConfig.__dataclass_fields__}
    return KeyframeConfig(**{**names, "columns": columns})


def opened_pieces(root: Path, settings: dict[str, Any], overwrite: bool) -> Path:
    """Folder of the pieces, new or left by a run with the same settings.

    Raises:
        ValueError: it was left by a run with other settings, and may not be overwritten.
    """
    folder = root.with_name(f"{root.name}.pieces")
    found = json.loads((folder / SETTINGS).read_text()) if (folder / SETTINGS).is_file() else settings
    changed = [name for name, value in settings.items() if found.get(name) != value]
    if changed and not overwrite:
        raise ValueError(
            f"{folder} holds pieces made with other settings ({', '.join(changed)}); delete it, choose another root, "
            "or start over with --overwrite=true"
        )
    if changed:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / SETTINGS, settings)
    return folder


def submit(
    executor: "type[SlurmPipelineExecutor]", config: KeyframeManyConfig, work: KeyframePiece, merge: MergePieces
) -> None:
    """Submit a job per piece, and one that merges when all of them have succeeded."""
    environment = Path(sys.prefix) / "bin/activate"
    options: dict[str, Any] = {
        "skip_completed": False,  # finished pieces know it themselves
        "time": config.slurm.time,
        "partition": config.slurm.partition,
        "qos": config.slurm.qos,
        "mem_per_cpu_gb": config.slurm.memory,
        "venv_path": str(environment) if environment.is_file() else None,
    }
    logs = work.folder / "logs"
    pieces = executor([work], merge.pieces, job_name="histmv-keyframe", logging_dir=str(logs / "pieces"), **options)
    last = executor([merge], 1, job_name="histmv-merge", logging_dir=str(logs / "merge"), depends=pieces, **options)
    last.run()
