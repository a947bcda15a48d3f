"""One page that shows what a demo made: success, videos, one keyframed episode, the loss curve, time per stage."""

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dataset_tools.demo import EVALUATION, KEYFRAMES, PAGE
from dataset_tools.demo_figures import draw_contact_sheet, draw_losses, read_keyframes, read_losses
from dataset_tools.eval_results import Episode, read_episodes
from dataset_tools.stages import LOG_FOLDER, duration, read_state

MOST_VIDEOS = 12

TEMPLATE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>HistMV demo</title>
<style>
  body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
  h1 {{ margin-bottom: 0; }} h2 {{ margin-top: 2.5rem; }}
  .success {{ font-size: 1.6rem; }}
  img {{ max-width: 100%; }}
  .videos {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(17rem, 1fr)); gap: 1rem; }}
  video {{ width: 100%; background: #eee; }} figure {{ margin: 0; }} figcaption {{ font-size: .85rem; color: #555; }}
  td:nth-child(2) {{ white-space: nowrap; }}
  td, th {{ padding: .15rem 1.5rem .15rem 0; text-align: left; vertical-align: top; }} code {{ font-size: .8rem; }}
</style>
<h1>HistMV demo</h1>
<p>A policy learned from recorded demonstrations, asked for scenes that it has never seen.</p>
<p class="success">{success}</p>
<h2>Evaluation</h2><div class="videos">{videos}</div>
<h2>What it learned from</h2>
<p>One demonstration after keyframing: each row is one macro step, with why its keyframe was kept and when.</p>
<img src="{sheet}" alt="contact sheet of one keyframed episode">
<h2>Training</h2><img src="{losses}" alt="loss over training steps">
<h2>Commands</h2><table><tr><th>stage</th><th>time</th><th>command and log</th></tr>{stages}</table>
</html>
"""


@dataclass
class ReportConfig:
    """Write a demo's page and pictures again."""

    # the demo's folder
    folder: Path = Path("outputs/demo")


def success_line(folder: Path) -> str:
    """How many evaluated scenes succeeded, from the evaluation's ``eval_info.json``."""
    overall = json.loads((folder / EVALUATION / "eval_info.json").read_text())["overall"]
    low, high = overall["wilson_95"]
    return (
        f"{overall['n_successes']} of {overall['n_episodes']} unseen scenes succeeded: {overall['pc_success']:.0f} % "
        f"(95 % interval {low:.0f} to {high:.0f} %)."
    )


def video_tags(folder: Path) -> str:
    """The evaluation's first videos, each with what was asked and what came of it."""
    filmed = [episode for episode in read_episodes(folder / EVALUATION / "episodes.jsonl") if episode.video]
    if not filmed:
        return "<p>The evaluation wrote no videos.</p>"
    figure = (
        '<figure><video controls muted loop preload="metadata" src="{}"></video><figcaption>{}</figcaption></figure>'
    )
    return "".join(
        figure.format(html.escape(f"{EVALUATION}/{episode.video}"), html.escape(caption(episode)))
        for episode in filmed[:MOST_VIDEOS]
    )


def caption(episode: Episode) -> str:
    """One line about an evaluated episode."""
    outcome = "success" if episode.success else f"failed: {episode.failure}"
    return f"“{episode.instruction}”: {outcome} (scene {episode.seed})"


def stage_rows(folder: Path) -> str:
    """A table row per finished stage."""
    row = '<tr><td>{}</td><td>{}</td><td><code>{}</code> (<a href="{}/{}.log">log</a>)</td></tr>'
    return "".join(
        row.format(name, duration(record.seconds), html.escape(" ".join(record.command)), LOG_FOLDER, name)
        for name, record in read_state(folder).items()
        if record.finished
    )


def draw(folder: Path) -> Sequence[str]:
    """Write the pictures; returns their names."""
    sheet, losses = "keyframes.png", "loss.png"
    draw_contact_sheet(read_keyframes(folder / KEYFRAMES, episode=0), folder / sheet)
    with (folder / LOG_FOLDER / "train.log").open() as lines:
        draw_losses(read_losses(lines), folder / losses)
    return sheet, losses


def run(config: ReportConfig) -> None:
    """Write the pictures and the page.

    Raises:
        OSError: the folder lacks a stage's results.
    """
    folder = config.folder
    sheet, losses = draw(folder)
    page = TEMPLATE.format(
        success=html.escape(success_line(folder)),
        videos=video_tags(folder),
        sheet=sheet,
        losses=losses,
        stages=stage_rows(folder),
    )
    temporary = folder / f"{PAGE}.tmp"
    temporary.write_text(page)
    temporary.replace(folder / PAGE)
    print(f"wrote {folder / PAGE}")
