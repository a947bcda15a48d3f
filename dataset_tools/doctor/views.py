"""Checks of one episode's sampled images: of each camera alone, then of cameras that are right against each other."""

from collections.abc import Set

from dataset_tools.doctor import geometry, images
from dataset_tools.doctor.calibration import evenly
from dataset_tools.doctor.findings import Finding, Severity
from dataset_tools.doctor.geometry import DepthView, Instant
from dataset_tools.doctor.layout import Layout
from dataset_tools.doctor.read import EpisodeRows, Pictures, pictures
from dataset_tools.source import Source

FRAMES = 4
"""Frames looked at in an episode, first and last among them."""


def check_images(source: Source, layout: Layout, rows: EpisodeRows, faulty: Set[str]) -> list[Finding]:
    """Findings of an episode.

    Args:
        source: the dataset.
        layout: its cameras.
        rows: the episode's numbers.
        faulty: cameras with an error, which are not compared with others.
    """
    frames = evenly(len(rows.frame_index), FRAMES)
    read, found = pictures(source, layout, rows.episode, frames)
    for camera, seen in read.items():
        found += check_camera(layout, camera, seen, rows)
    faulty = faulty | {finding.camera for finding in found if finding.severity == Severity.ERROR}
    views = {
        camera: seen
        for camera, seen in read.items()
        if camera in layout.intrinsics.keys() & layout.extrinsics.keys() and seen.depth and camera not in faulty
    }
    instants = [instant(layout, rows, views, frame) for frame in frames]
    moving = geometry.camera_moves(instants, rows.episode)
    compared = moving or [
        *geometry.views_disagree(instants, rows.episode),
        *geometry.views_apart(instants, rows.episode),
    ]
    return found + compared


def check_camera(layout: Layout, camera: str, seen: Pictures, rows: EpisodeRows) -> list[Finding]:
    """Checks of one camera's images."""
    found = []
    for frame, image in seen.rgb.items():
        found += images.image_blank(image, camera, rows.episode, frame)
    if layout.position is not None:
        found += images.image_frozen(seen.rgb, layout.position.of(rows.vectors), camera, rows.episode)
    if seen.depth:
        found += images.depth_unit(seen.depth.values(), seen.unit, camera, rows.episode)
        found += images.depth_invalid(seen.depth.values(), camera, rows.episode)
    return found


def instant(layout: Layout, rows: EpisodeRows, views: dict[str, Pictures], frame: int) -> Instant:
    """What all cameras measured at one frame."""
    return [
        DepthView(
            camera,
            seen.depth[frame],
            layout.intrinsics[camera].of(rows.vectors)[frame],
            rows.extrinsics(layout, camera)[frame],
        )
        for camera, seen in views.items()
        if frame in seen.depth
    ]
