"""H.264 videos that browsers play, written frame by frame so that an episode never lies in memory as a whole."""

from pathlib import Path
from types import TracebackType

import av
import numpy as np
from jaxtyping import UInt8

ENCODERS = ("libx264", "libopenh264", "h264")
"""H.264 encoders, best first; which exist depends on how PyAV was built."""
TEMPORARY = ".part"


def h264_encoder() -> str:
    """Name of the best H.264 encoder that this PyAV has.

    Raises:
        ValueError: it has none.
    """
    for name in ENCODERS:
        try:
            av.codec.Codec(name, "w")
        except ValueError:
            continue
        return name
    raise ValueError(
        f"PyAV {av.__version__} has none of the H.264 encoders {list(ENCODERS)}; install PyAV's wheel, or --videos=0"
    )


class VideoWriter:
    """Writes an mp4 file; it appears under its name whole, or not at all.

    Args:
        path: file to write; its folder is made, and an older file is replaced.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: int) -> None:
        self.path = path
        self._temporary = path.with_name(path.name + TEMPORARY)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self._temporary), "w", format="mp4", options={"movflags": "faststart"})
        encoder = h264_encoder()
        options = {"preset": "veryfast", "crf": "22"} if encoder == "libx264" else {}
        stream = self._container.add_stream(encoder, rate=fps, options=options)
        assert isinstance(stream, av.VideoStream)
        self._stream = stream
        self._stream.pix_fmt = "yuv420p"
        self._started = False

    def add(self, frame: UInt8[np.ndarray, "y x 3"]) -> None:
        """Append an RGB frame; all frames have the size of the first, whose sides are even."""
        rows, columns = frame.shape[:2]
        if not self._started:
            if rows % 2 or columns % 2:
                raise ValueError(f"a frame of {rows} x {columns} pixels cannot be encoded; both sides must be even")
            self._stream.height, self._stream.width = rows, columns
            self._started = True
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))

    def close(self) -> None:
        """Finish the file and give it its name."""
        self._container.mux(self._stream.encode())
        self._container.close()
        self._temporary.replace(self.path)

    def abandon(self) -> None:
        """Delete what was written so far."""
        self._container.close()
        self._temporary.unlink(missing_ok=True)

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()
