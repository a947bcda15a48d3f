"""Puts the frame reader into the datasets that ``lerobot-train`` makes for the policy ``histmv``.

LeRobot has no setting for the dataset class, so its ``make_train_eval_datasets`` is wrapped. The wrapper also refuses
settings that would silently break training, and gives a resumed training the sampler that goes on in the right epoch;
it leaves other policies alone.
"""

import functools
import inspect
import logging
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, factory
from lerobot.utils.constants import HF_LEROBOT_HOME
from packaging.specifiers import SpecifierSet

from lerobot_histmv import keys
from lerobot_histmv.data import checks, memory

logger = logging.getLogger(__name__)

CHECKED_VERSIONS = SpecifierSet(">=0.6.1,<0.7", prereleases=True)
"""LeRobot versions whose reader the frame reader is known to equal."""
FUNCTION, SAMPLER = "make_train_eval_datasets", "EpisodeAwareSampler"
HOLDERS = ("lerobot.datasets.factory", "lerobot.scripts.lerobot_train", "__main__")
"""Modules that may hold them under these names; the last when the script is run by ``python -m``."""


def install(dataset: Any) -> bool:
    """Let ``dataset``, a ``LeRobotDataset``, read decoded frames from the cache; tells whether it does.

    The samples stay the same bit for bit. With a version of LeRobot that was not checked, or a dataset of another
    class, nothing changes and a warning says so.

    Raises:
        ValueError: the dataset is damaged, or holds numbers that no policy can learn from.
    """
    if version("lerobot") not in CHECKED_VERSIONS:
        logger.warning("LeRobot %s is none of %s: its own, slow reader is used", version("lerobot"), CHECKED_VERSIONS)
        return False
    if type(dataset) is not LeRobotDataset:
        logger.warning("%s has no frame reader: LeRobot's own, slow reader is used", type(dataset).__name__)
        return False
    from lerobot_histmv.data.reader import FrameReader  # imports LeRobot's internals, which other versions may lack

    assert dataset.hf_dataset is not None  # loads the table if it is not
    dataset.reader = FrameReader.from_reader(dataset.reader)
    checks.check_dataset(dataset.meta, dataset.reader.columns.arrays)
    return True


def reach_back(dataset: Any, steps: int) -> None:
    """Let the samples of ``dataset`` have ``steps`` more rows of the state, before all others.

    A map that the policy remembers shows the tool positions of the steps before it. In the windows of long episodes,
    those of the first rows lie before the rows that LeRobot hands over; it has one reach for all observations.
    """
    indices = dataset.reader.delta_indices if type(dataset) is LeRobotDataset else None
    if indices is not None:
        first = indices[keys.STATE][0]
        indices[keys.STATE] = [*range(first - steps, first), *indices[keys.STATE]]


def install_hook() -> None:
    """Wrap LeRobot's ``make_train_eval_datasets`` wherever it is already known; once, however often it is called."""
    original = getattr(factory, FUNCTION, None)
    if original is None or list(inspect.signature(original).parameters) != ["cfg"]:
        logger.warning("LeRobot %s has no %s(cfg): its own, slow reader is used", version("lerobot"), FUNCTION)
    elif not hasattr(original, "__wrapped__"):
        _replace(FUNCTION, original, _wrap(original))


def remove_hook() -> None:
    """Undo ``install_hook``."""
    wrapper, sampler = getattr(factory, FUNCTION), getattr(sys.modules.get(HOLDERS[1]), SAMPLER, None)
    if hasattr(wrapper, "__wrapped__"):
        _replace(FUNCTION, wrapper, wrapper.__wrapped__)
    if isinstance(sampler, functools.partial):
        _replace(SAMPLER, sampler, EpisodeAwareSampler)


def _replace(name: str, old: Any, new: Any) -> None:
    for holder in HOLDERS:
        module = sys.modules.get(holder)
        if module is not None and vars(module).get(name) is old:
            setattr(module, name, new)


def _wrap(original: Callable) -> Callable:
    @functools.wraps(original)
    def make_train_eval_datasets(cfg: Any) -> Any:
        if cfg.policy is None or cfg.policy.type != "histmv":
            return original(cfg)
        checks.check_training(cfg)
        memory.keep_freed_memory()
        if cfg.resume and version("lerobot") in CHECKED_VERSIONS:
            _resume(cfg.batch_size)
        made = _make(original, cfg)
        for dataset in made:
            if dataset is not None:
                if install(dataset):
                    checks.check_approach(cfg.policy.loss, dataset.meta, dataset.reader.columns.arrays)
                reach_back(dataset, cfg.policy.network.history.past_steps)
        return made

    return make_train_eval_datasets


def _resume(batch_size: int) -> None:
    """Let the script make our sampler instead of LeRobot's."""
    from accelerate import PartialState

    from lerobot_histmv.data.resume import ResumedSampler  # imports LeRobot's internals, which other versions may lack

    processes = PartialState().num_processes
    made = functools.partial(ResumedSampler, batch_size=batch_size, processes=processes)
    _replace(SAMPLER, EpisodeAwareSampler, made)


def _make(original: Callable, cfg: Any) -> Any:
    """Call ``original``; where it fails because of missing or truncated files, say which."""
    try:
        return original(cfg)
    except Exception as failure:
        root = Path(cfg.dataset.root or HF_LEROBOT_HOME / cfg.dataset.repo_id)
        if cfg.dataset.root or root.is_dir():
            try:
                checks.check_files(root)
            except ValueError as reason:
                raise reason from failure
        raise
