"""What a camera's calibration must be, whichever file it comes from."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

ROTATION_TOLERANCE = 1e-3
"""How far the entries of R R' may be from the identity's: calibrations are written with four digits and more."""


def rigid(matrices: ArrayLike, what: str) -> Float[np.ndarray, "... 3 4"]:
    """Rigid transforms given as 3x4 or 4x4 matrices.

    Raises:
        ValueError: another shape, a number that is not finite, a rotation that is not orthonormal or mirrors; the
            message begins with ``what``.
    """
    transforms = np.asarray(matrices, dtype=np.float64)
    if transforms.shape[-2:] not in ((3, 4), (4, 4)):
        raise ValueError(f"{what} has shape {transforms.shape[-2:]}; it must be a 3x4 or 4x4 matrix")
    if not np.isfinite(transforms).all():
        raise ValueError(f"{what} holds values that are not finite")
    if transforms.shape[-2] == 4 and not np.allclose(transforms[..., 3, :], [0, 0, 0, 1], atol=1e-6):
        raise ValueError(f"{what} ends with another row than 0 0 0 1; the translation belongs into the last column")
    rotation = transforms[..., :3, :3]
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    if error > ROTATION_TOLERANCE:
        raise ValueError(f"{what} holds no rotation: R R' is off the identity by {error:.2g}; it must be orthonormal")
    if (np.linalg.det(rotation) < 0).any():
        raise ValueError(
            f"{what} mirrors (determinant -1): one axis has the wrong sign; axes are x right, y down, z ahead"
        )
    return transforms[..., :3, :]


def pinhole(intrinsics: Float[np.ndarray, "... 4"], size: tuple[int, int], what: str) -> Float[np.ndarray, "... 4"]:
    """The same fx, fy, cx, cy [pixels], checked.

    Args:
        intrinsics: one or many.
        size: height and width of the images.
        what: begins the message.

    Raises:
        ValueError: a focal length that is not positive, a principal point outside of the image.
    """
    fx, fy, cx, cy = np.moveaxis(intrinsics, -1, 0)
    if not ((fx > 0) & (fy > 0)).all():
        raise ValueError(f"{what}: fx, fy are {np.min(fx):g}, {np.min(fy):g}; focal lengths must be positive")
    for name, centre, length in (("cx", cx, size[1]), ("cy", cy, size[0])):
        if not ((centre >= -0.5) & (centre <= length - 0.5)).all():
            raise ValueError(
                f"{what}: {name} is {np.max(centre):g}, outside of the image, which is {size[1]} x {size[0]} pixels; "
                "was the camera calibrated at another resolution?"
            )
    return intrinsics
