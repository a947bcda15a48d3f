"""What the page says of an explained episode: facts, the table of decisions, and how to read each picture."""

import html
from collections.abc import Sequence

import numpy as np

from dataset_tools.explain.board import decision_text
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.step_panels import draw_history, draw_poses
from dataset_tools.explain.view_panels import draw_information, draw_weights
from dataset_tools.page import Chapter, Exhibit, Panel

FILM = (
    "The film",
    "Right, at every decision: each view under its heat map (bright: there). The framed view acted: it has most of the "
    "common heat, or the largest weight times certainty; each view also says where it alone would have sent the tool. "
    "The green cross is where the tool is sent, a white ring where the demonstration went. Below, the steps in memory "
    "with the attention that each got, and how far the target would move without it.",
)
FAR = 0.05
"""A decision this far off the true position [m] went wrong."""
SHEET = ("Every decision", "The same pictures as in the film, all at once.")


def _lacks_nothing(_: Explained) -> str:
    return ""


def _lacks_views(episode: Explained) -> str:
    return "a second view" if len(episode.cameras) == 1 else ""


def _lacks_history(episode: Explained) -> str:
    return "" if any(len(one.influence) for one in episode.records) else "a past: no decision had one"


PANELS = (
    Panel(
        "views",
        "Which view acted",
        "Each decision in the view that acted, framed in its colour, and the weights of all views over the decisions. "
        "A bold name and a dotted line mark where another view takes over.",
        _lacks_nothing,
        draw_weights,
    ),
    Panel(
        "history",
        "What the history was used for",
        "A row per decision, a column per step. Blue: share of what the decision took from that step. Orange: how far "
        "the target would move if that step were not seen; attention to a step that changes nothing is idle.",
        _lacks_history,
        draw_history,
    ),
    Panel(
        "poses",
        "Where the tool was sent",
        "Thin: predicted. Thick: the demonstration's pose, or, in a rollout, where the tool arrived.",
        _lacks_nothing,
        draw_poses,
    ),
    Panel(
        "information",
        "What the views share",
        "Normalised mutual information: 0, the views say different things; 1, each says what the other says.",
        _lacks_views,
        draw_information,
    ),
)


def chapter(episode: Explained, exhibits: Sequence[Exhibit]) -> Chapter:
    """What is to be said of ``episode``, whose pictures were written already."""
    title = f"{episode.name.capitalize()}: “{episode.instruction}”"
    return Chapter(episode.name, title, facts(episode), notes(episode), decision_table(episode), exhibits)


def facts(episode: Explained) -> str:
    """How it ended, how often the view changed and how good the poses were, in one line."""
    found = [episode.outcome] if episode.outcome else []
    cameras = episode.cameras
    shifts = [f"{cameras[episode.chosen[i - 1]]} to {cameras[episode.chosen[i]]} at {i + 1}" for i in episode.changes]
    found += [f"{len(episode.records)} decisions", f"the acting view changes {len(shifts)} times"]
    if shifts:
        found[-1] += f" ({', '.join(shifts)})"
    if episode.truth is not None:
        errors, right = 1000 * episode.errors, int(episode.gripper_right.sum())
        found.append(f"distance to the true pose: median {np.median(errors):.0f} mm, largest {errors.max():.0f} mm")
        found.append(f"rotation: median {np.median(episode.turns):.0f} degrees off")
        found.append(f"gripper right in {right} of {len(errors)}")
    return "; ".join(found)


def notes(episode: Explained) -> list[str]:
    """A sentence per decision that went wrong although another view knew better."""
    if episode.truth is None:
        return []
    off = np.linalg.norm(np.stack([one.targets for one in episode.records]) - episode.truth[:, None, :3], axis=2)
    found = []
    for index, (errors, acted, chosen) in enumerate(zip(off, episode.errors, episode.chosen, strict=True)):
        best = int(errors.argmin())
        if acted > FAR and errors[best] < acted / 2:
            found.append(
                f"decision {index + 1}: {episode.cameras[chosen]} acted, {100 * acted:.0f} cm off; "
                f"{episode.cameras[best]} alone would have been {100 * errors[best]:.0f} cm off"
            )
    return found


def decision_table(episode: Explained) -> str:
    """The decisions as an HTML table, folded so that the film comes first."""
    head = [
        "",
        "decision",
        "acts",
        *(f"weight, {episode.records[0].choosing.support}, {camera} [%]" for camera in episode.cameras),
        "without its past, elsewhere by [cm]",
    ]
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in _cells(episode, index)) + "</tr>"
        for index in range(len(episode.records))
    )
    titles = "".join(f"<th>{html.escape(title)}</th>" for title in head)
    return f"<details><summary>all decisions as a table</summary><table><tr>{titles}</tr>{rows}</table></details>"


def _cells(episode: Explained, index: int) -> list[str]:
    record = episode.records[index]
    truth = None if episode.truth is None else episode.truth[index]
    pairs = zip(record.weights, record.support, strict=True)
    scores = [f"{100 * weight:.0f}, {100 * support:.0f}" for weight, support in pairs]
    text = decision_text(record, truth)
    return [str(index + 1), text, episode.cameras[record.chosen], *scores, f"{100 * record.memory:.1f}"]
