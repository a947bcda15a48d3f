r"""The tiny CLIP pretrained: renderings of the tasks' scenes against their instructions, with CLIP's own loss.

    python benchmarks/tiny_clip.py [--output=outputs/tiny_clip] [--scenes=150] [--steps=600] [--threads=2]

Six minutes on a core. The weights, ``OUTPUT/tiny.pt``, start a policy's towers, which train on with it:

    lerobot-train ... --policy.network.semantics.clip_pretrained=outputs/tiny_clip/tiny.pt \
                      --policy.network.semantics.train_clip=true

Scenes are those of all tasks, from seeds that no recording and no evaluation uses; the instructions' paraphrases that
are held out stay unread. Killed and started again, it continues. How often an image of an unseen scene finds its
instruction, its task, goes to ``benchmarks/results/tiny_clip.json``.
"""

import argparse
import os
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional
from tqdm import tqdm

from dataset_tools.shards import write_json
from lerobot_histmv import keys
from lerobot_histmv.envs import make
from lerobot_histmv.envs.tasks.suites import SUITES
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.semantics import TINY, ClipTowers

RESULTS = Path(__file__).parent / "results" / "tiny_clip.json"
SIDE = TINY["vision_cfg"]["image_size"]
FIRST_SEED = 900_000
BATCH, RATE, WEIGHT_DECAY, WARM_UP = 192, 1e-3, 0.05, 0.1
BRIGHTNESS, COLOUR = 0.06, 0.1
"""Widest change of a picture's brightness (added) and of its colour channels (share)."""
TEMPERATURE = 0.07
"""Of the softmax at the beginning (Radford et al. 2021)."""
SAVE_EVERY = 100
HELD_BACK = 120
"""Scenes that only measure."""


@dataclass(frozen=True)
class Scene:
    """A task's start: the cameras' colours, and all sentences that ask for it."""

    task: str
    views: UInt8[np.ndarray, "v y x 3"]
    sentences: tuple[str, ...]


def render(task: str, count: int) -> list[Scene]:
    """Scenes of a task in the size that the tower takes."""
    env = make(task, image_size=SIDE, render_size=SIDE)
    scenes = []
    for seed in range(FIRST_SEED, FIRST_SEED + count):
        pixels = env.reset(seed=seed)[0]["pixels"]
        views = [image for name, image in pixels.items() if not name.endswith(keys.DEPTH_SUFFIX)]
        scenes.append(Scene(task, np.stack(views), env.paraphrases))
    env.close()
    return scenes


def all_scenes(folder: Path, count: int) -> list[Scene]:
    """Scenes of all tasks; each task's are kept in a file when they are done."""
    scenes: list[Scene] = []
    for task in tqdm(SUITES["all"], desc="render", unit="task"):
        file = folder / f"{task}_{count}.pt"
        if not file.exists():
            save([(scene.task, scene.views, scene.sentences) for scene in render(task, count)], file)
        scenes += [Scene(*parts) for parts in torch.load(file, weights_only=False)]
    return scenes


def save(content: Any, file: Path) -> None:
    """Write a file that appears whole, in a folder that may be new."""
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(".tmp")
    torch.save(content, temporary)
    temporary.replace(file)


def pictures(views: Sequence[UInt8[np.ndarray, "y x 3"]]) -> Float[Tensor, "n 3 y x"]:
    """Colours in [0, 1]."""
    return rearrange(torch.from_numpy(np.stack(views)), "n y x c -> n c y x").float() / 255


def recoloured(rgb: Float[Tensor, "n 3 y x"]) -> Float[Tensor, "n 3 y x"]:
    """Every picture in another light."""
    shape = rgb.shape[0]
    colour = 1 + COLOUR * (2 * torch.rand(shape, 3, 1, 1) - 1)
    return (rgb * colour + BRIGHTNESS * (2 * torch.rand(shape, 1, 1, 1) - 1)).clamp(0, 1)


def same_request(scenes: Sequence[Scene]) -> Bool[Tensor, "n n"]:
    """Which scenes ask for the same: their sentences fit each other's pictures as well."""
    return torch.tensor([[one.sentences == other.sentences for other in scenes] for one in scenes])


def contrastive_loss(similarity: Float[Tensor, "n n"], same: Bool[Tensor, "n n"]) -> Float[Tensor, ""]:
    """CLIP's symmetric cross entropy (Radford et al. 2021), with all that ask for the same as equally right answers.

    Args:
        similarity: of picture (row) and sentence (column), divided by the temperature.
        same: symmetric; the diagonal is true.
    """
    target = same / same.sum(1, keepdim=True)
    return (functional.cross_entropy(similarity, target) + functional.cross_entropy(similarity.T, target)) / 2


class Training:
    """Towers, optimiser and chance; goes on from the file that it wrote last.

    Args:
        folder: of the file.
        scenes: to learn from.
        steps: until the learning rate is down.
        batch: pictures per step.
    """

    def __init__(self, folder: Path, scenes: Sequence[Scene], steps: int, batch: int) -> None:
        torch.manual_seed(0)
        self.scenes, self.batch, self.done = scenes, batch, 0
        self.rng = random.Random(0)
        self.towers = ClipTowers(SemanticsConfig())
        self.scale = nn.Parameter(torch.tensor(np.log(1 / TEMPERATURE)))
        weights = [*self.towers.parameters(), self.scale]
        self.optimizer = torch.optim.AdamW(weights, RATE, weight_decay=WEIGHT_DECAY)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, RATE, total_steps=steps, pct_start=WARM_UP)
        self.file = folder / f"training_{steps}_steps_of_{batch}_from_{len(scenes)}_scenes.pt"
        if self.file.exists():
            self.restore()

    def step(self) -> float:
        """One step; its loss."""
        chosen = self.rng.sample(self.scenes, self.batch)
        images = recoloured(pictures([self.rng.choice(scene.views) for scene in chosen]))
        sentences = [self.rng.choice(scene.sentences) for scene in chosen]
        similarity = self.scale.exp() * self.towers.images(images) @ self.towers.text(sentences).T
        loss = contrastive_loss(similarity, same_request(chosen))
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.done += 1
        return loss.item()

    def save(self) -> None:
        """Keep all that the next step depends on."""
        parts = {name: getattr(self, name).state_dict() for name in ("towers", "optimizer", "schedule")}
        chance = {"python": self.rng.getstate(), "torch": torch.get_rng_state()}
        save({**parts, "scale": self.scale.detach(), "done": self.done, **chance}, self.file)

    def restore(self) -> None:
        """Take up what was kept."""
        kept = torch.load(self.file, weights_only=False)
        for name in ("towers", "optimizer", "schedule"):
            getattr(self, name).load_state_dict(kept[name])
        self.scale.data.copy_(kept["scale"])
        self.done = kept["done"]
        self.rng.setstate(kept["python"])
        torch.set_rng_state(kept["torch"])


@torch.no_grad()
def accuracy(towers: ClipTowers, scenes: Sequence[Scene]) -> dict[str, float]:
    """Shares of pictures whose most similar sentence asks for their scene's request, and at least for its task."""
    towers.eval()
    requests = {scene.sentences: scene.task for scene in scenes}
    texts = towers.text([sentences[0] for sentences in requests])
    right = []
    for scene in scenes:
        for best in (towers.images(pictures(list(scene.views))) @ texts.T).argmax(1).tolist():
            sentences, task = list(requests.items())[best]
            right.append((sentences == scene.sentences, task == scene.task))
    return dict(zip(("request", "task"), np.mean(right, axis=0).round(3).tolist(), strict=True))


def pretrain(folder: Path, scenes: list[Scene], steps: int, batch: int = BATCH) -> ClipTowers:
    """Train, or go on with it; the weights lie in ``folder/tiny.pt``, in half precision."""
    training = Training(folder, scenes, steps, batch)
    with tqdm(range(training.done, steps), initial=training.done, total=steps, desc="train") as bar:
        for step in bar:
            bar.set_postfix(loss=f"{training.step():.2f}")
            if (step + 1) % SAVE_EVERY == 0:
                training.save()
    save({name: value.half() for name, value in training.towers.clip.state_dict().items()}, folder / "tiny.pt")
    return training.towers


def main() -> None:
    """Render, train, measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("outputs/tiny_clip"))
    parser.add_argument("--scenes", type=int, default=150, help="of each task")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    scenes = all_scenes(args.output / "scenes", args.scenes)
    random.Random(0).shuffle(scenes)
    towers = pretrain(args.output, scenes[HELD_BACK:], args.steps)
    requests = len({scene.sentences for scene in scenes[:HELD_BACK]})
    measured = {"scenes": HELD_BACK, "requests": requests, **accuracy(towers, scenes[:HELD_BACK])}
    write_json(RESULTS, {"trained on": len(scenes) - HELD_BACK, "steps": args.steps, "unseen": measured})
    print(measured)


if __name__ == "__main__":
    main()
