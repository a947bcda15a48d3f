"""A trained policy to hand on: record, keyframe, train, evaluate, and pack the checkpoint with its card.

    python benchmarks/release_asset.py [--setting=pick_and_lift] [--output=outputs/release] [--threads=2]
    python benchmarks/release_asset.py --preset=train/debug --episodes=2 --steps=2 --scenes=1 --output=outputs/small

The first makes what a release carries, in half an hour on two cores; the second shows in minutes that everything runs.
Killed and started again, it continues. The archive and a file with its SHA-256 lie in the output folder; the same
checkpoint gives the same archive, byte for byte. What the first made goes to ``benchmarks/results/release_asset.json``.
"""

import argparse
import gzip
import hashlib
import json
import os
import re
import shutil
import tarfile
from pathlib import Path
from typing import Any

from rich.console import Console
from success import (
    SCENES,
    SETTINGS,
    add_result,
    command_environment,
    data_stages,
    evaluation_stage,
    told,
    training_stage,
)

from dataset_tools.demo import last_checkpoint
from dataset_tools.hub import push
from dataset_tools.shards import write_json
from dataset_tools.stages import Stage, run_stages, say

RESULTS = Path(__file__).parent / "results" / "release_asset.json"
OUTPUT = Path("outputs/release")
LICENSE = Path(__file__).parents[1] / "LICENSE"
TEXTS = ("*.json", "*.md", "LICENSE")
PLACE = re.compile(r"(?<![\w./:$}*])/(?:[\w.+-]+/)+[\w.+-]+")
"""An absolute path: two names or more, not inside of an address, a relative path or a word such as and/or."""
PLACES: dict[str, dict[str, Any]] = {
    "config.json": {"pretrained_path": None},
    "train_config.json": {
        "output_dir": None,
        "resume": False,
        "dataset": {"root": None},
        "policy": {"pretrained_path": None},
    },
}
"""Entries of a checkpoint's settings that say where it was made, or that a killed training went on, and what they
become: elsewhere they would name nothing."""


def stages(args: argparse.Namespace, folder: Path) -> list[Stage]:
    """All commands behind the asset; they write to ``folder``."""
    options = [f"--steps={args.steps}"] if args.steps else []
    return [
        *data_stages(args.setting, folder, args.episodes),
        training_stage(args.setting, args.seed, folder, folder, args.preset, *options),
        evaluation_stage(args.setting, last_checkpoint(folder / "train"), folder / "evaluation", count=args.scenes),
    ]


def pack(checkpoint: Path, evaluation: Path, name: str, output: Path) -> Path:
    """Write ``output/name.tar.gz``: the checkpoint, its card and the licence, and beside it the archive's SHA-256.

    Args:
        checkpoint: the folder of ``model.safetensors``.
        evaluation: results of ``histmv eval`` of this very checkpoint.
        name: of the archive and of the folder inside of it.
        output: where both are made.

    Raises:
        ValueError: the results are those of another checkpoint, or a text names a place on this machine.
    """
    folder = output / name
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for path in (*checkpoint.glob("*.safetensors"), *checkpoint.glob("*.json")):
        shutil.copyfile(path, folder / path.name)
    # The card tells of the data, which the settings still name.
    push.run(push.PushConfig(f"local/{name}", root=folder, evaluation=evaluation, upload=False))
    shutil.copyfile(LICENSE, folder / LICENSE.name)
    forget_places(folder)
    check_places(folder)
    archive = compress(folder, output / f"{name}.tar.gz")
    archive.with_name(f"{archive.name}.sha256").write_text(f"{sha256(archive)}  {archive.name}\n")
    return archive


def forget_places(folder: Path) -> None:
    """Replace what the checkpoint's settings say of ``PLACES``."""
    for name, entries in PLACES.items():
        if (path := folder / name).is_file():
            write_json(path, _replaced(json.loads(path.read_text(encoding="utf-8")), entries))


def _replaced(settings: dict[str, Any], entries: dict[str, Any]) -> dict[str, Any]:
    new = {
        name: _replaced(settings[name], value) if isinstance(value, dict) else value
        for name, value in entries.items()
        if name in settings
    }
    return settings | new


def check_places(folder: Path) -> None:
    """Raise ValueError if a text in ``folder`` holds an absolute path."""
    for path in sorted(path for pattern in TEXTS for path in folder.glob(pattern)):
        if found := PLACE.search(path.read_text(encoding="utf-8")):
            raise ValueError(f"{path.name} names a place on this machine, {found[0]}; give relative paths instead")


def compress(folder: Path, archive: Path) -> Path:
    """Pack the files of ``folder`` under its name; the bytes depend on nothing but names and content."""
    temporary = archive.with_name(f"{archive.name}.tmp")
    with (
        temporary.open("wb") as file,
        gzip.GzipFile("", "wb", fileobj=file, mtime=0) as zipped,
        tarfile.open(fileobj=zipped, mode="w") as tar,
    ):
        for path in sorted(folder.iterdir()):
            member = tarfile.TarInfo(f"{folder.name}/{path.name}")
            member.size = path.stat().st_size
            with path.open("rb") as content:
                tar.addfile(member, content)
    temporary.replace(archive)
    return archive


def sha256(file: Path) -> str:
    """Digest of a file, as ``sha256sum`` prints it."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--setting", choices=SETTINGS, default="pick_and_lift", help="task and its demonstrations")
    parser.add_argument("--preset", default="train/default", help="training settings, as `histmv configs` lists them")
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--episodes", type=int, help="demonstrations, if not as many as the setting has")
    parser.add_argument("--steps", type=int, help="of the training, if not as many as the preset has")
    parser.add_argument("--scenes", type=int, default=SCENES, help="unseen ones to evaluate on")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="give it again to continue")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="of each command")
    return parser


def main() -> None:
    """Make the checkpoint, as far as it is not made, pack it, and say how large it is."""
    args, console = arguments().parse_args(), Console()
    folder = args.output / args.setting
    run_stages(stages(args, folder), folder, console, command_environment(args.threads))
    archive = pack(last_checkpoint(folder / "train"), folder / "evaluation", f"histmv_{args.setting}", args.output)
    if not (args.episodes or args.steps) and args.scenes == SCENES:
        result = {"bytes": archive.stat().st_size, "sha256": sha256(archive)}
        result |= told(args.setting, args.threads, folder, args.output, OUTPUT)
        add_result(f"{args.setting}, {args.preset}, seed {args.seed}", result, RESULTS)
    say(console, f"{archive}: {archive.stat().st_size / 1e6:.1f} MB\nSHA-256 {sha256(archive)}")


if __name__ == "__main__":
    main()
