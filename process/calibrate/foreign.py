"""Camera calibrations of other programs: Caltech toolbox, OpenCV, ROS camera_info.

The Caltech toolbox prints about three standard deviations as its uncertainties (Bouguet, "Camera
Calibration Toolbox for Matlab", calibration example 1), so they are divided by three. It counts pixels
from 0 and has the same model as ours: fc, cc, alpha_c (skew), kc = k1 k2 p1 p2 k3.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.calibration import Intrinsics
from ...schemas.document import validate
from ...schemas.errors import InputError

Floats = npt.NDArray[np.float64]

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "camera_matrix_left", "mtx", "K", "k")
_LENS = (
    *("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "dist_coeff", "distCoeffs"),
    *("distortion", "dist", "D", "d"),
)
_WIDTH = ("image_width", "image_Width", "width", "imageWidth")
_HEIGHT = ("image_height", "image_Height", "height", "imageHeight")
_SIZE = ("image_size", "imageSize", "img_size", "size", "resolution")
_MATRIX_SIGMA = ("cameraMatrix_std_dev", "camera_matrix_std_dev", "camera_matrix_std_devs")
_LENS_SIGMA = ("dist_coeffs_std_dev", "distortion_coefficients_std_dev", "distCoeffs_std_dev")
_MODELS = ("plumb_bob", "pinhole", "opencv", "brown", "radtan", "rational_polynomial")
_NO_SIZE = "give the size of the images that it was made from: --size-px WIDTHxHEIGHT"


@dataclass(frozen=True)
class ForeignCamera:
    """What was read, which program's format it is, and what is not known of it."""

    intrinsics: Intrinsics
    source: str
    notes: tuple[str, ...]


def read_foreign_camera(
    data: bytes, *, where: str, size_px: tuple[int, int] | None = None
) -> ForeignCamera:
    """Intrinsics from the bytes of another program's file; its content says which format it has.

    ``size_px`` (width, height) is for files that do not say it, and must agree with those that do.

    Raises
    ------
    InputError
        The file is of no known format, lacks the matrix or the size, or holds another camera model.
    """
    if data.startswith((b"MATLAB 5.0", b"MATLAB 7")):
        return _caltech(data, where, size_px)
    tree = _tree(data, where)
    matrix = _numbers(_first(tree, _MATRIX), 9)
    if matrix is None:
        raise InputError(
            f"{where}: no camera matrix found; it holds {', '.join(list(tree)[:8]) or 'nothing'}",
            hint=f"looked for {', '.join(_MATRIX[:4])}, K",
        )
    _check_model(tree, where)
    k = matrix.reshape(3, 3)
    if k[0, 0] <= 0 or k[1, 1] <= 0 or abs(k[1, 0]) > 1e-9 or not np.allclose(k[2], (0, 0, 1)):
        raise InputError(f"{where}: {k.tolist()} is no camera matrix")
    sigma = np.zeros(10)
    spread = _numbers(_first(tree, _MATRIX_SIGMA), 4)
    if spread is not None:
        sigma[:4] = spread
    spread = _numbers(_first(tree, _LENS_SIGMA), None)
    if spread is not None:
        sigma[5:] = np.pad(spread[:5], (0, max(0, 5 - len(spread))))
    camera = {
        "fx_px": k[0, 0],
        "fy_px": k[1, 1],
        "cx_px": k[0, 2],
        "cy_px": k[1, 2],
        "skew": k[0, 1] / k[0, 0],
        "distortion": _five(_numbers(_first(tree, _LENS), None), where),
    }
    size = _size(tree, where, size_px)
    intrinsics = _intrinsics(camera, size, sigma if sigma.any() else None, where)
    notes = [
        "correlations are not in the file, taken as 0"
        if sigma.any()
        else "no uncertainties in the file"
    ]
    return ForeignCamera(intrinsics, "OpenCV or ROS", tuple(notes))


def _caltech(data: bytes, where: str, size_px: tuple[int, int] | None) -> ForeignCamera:
    from scipy.io import loadmat

    try:
        found: dict[str, Any] = loadmat(io.BytesIO(data))
    # SciPy's own word for MATLAB 7.3 files, which are HDF5; nothing of ours is missing here.
    except NotImplementedError as error:
        raise InputError(
            f"{where}: a MATLAB 7.3 file", hint="save it again with save(..., '-v7') in MATLAB"
        ) from error
    except (ValueError, TypeError, OSError, KeyError, EOFError, IndexError, MemoryError) as error:
        raise InputError(f"{where}: the MATLAB file is damaged ({error})") from error
    except Exception as error:
        # SciPy raises its own private class for broken streams.
        if type(error).__module__.startswith(("scipy", "zlib")):
            raise InputError(f"{where}: the MATLAB file is damaged ({error})") from error
        raise

    def vector(name: str, count: int) -> Floats | None:
        return _numbers(found.get(name), count)

    focal, centre = vector("fc", 2), vector("cc", 2)
    if focal is None or centre is None:
        names = ", ".join(k for k in found if not k.startswith("__"))
        raise InputError(
            f"{where}: no fc and cc, so no result of the Caltech toolbox; it holds {names[:120]}",
            hint="the toolbox's Save writes Calib_Results.mat",
        )
    skew, lens = vector("alpha_c", 1), _numbers(found.get("kc"), None)
    errors = {n: _numbers(found.get(f"{n}_error"), None) for n in ("fc", "cc", "alpha_c", "kc")}
    sigma = np.zeros(10)
    for name, at in (("fc", 0), ("cc", 2), ("alpha_c", 4), ("kc", 5)):
        three = errors[name]
        if three is not None:
            part = three[: min(len(three), 10 - at)] / 3.0
            sigma[at : at + len(part)] = part
    camera = {
        "fx_px": focal[0],
        "fy_px": focal[1],
        "cx_px": centre[0],
        "cy_px": centre[1],
        "skew": 0.0 if skew is None else skew[0],
        "distortion": _five(lens, where),
    }
    tree = {"width": found.get("nx"), "height": found.get("ny")}
    known = bool(np.isfinite(sigma).all() and sigma.any())
    intrinsics = _intrinsics(camera, _size(tree, where, size_px), sigma if known else None, where)
    note = (
        "its uncertainties, about 3 sigma, were divided by 3; correlations are not in the file"
        if known
        else "no uncertainties in the file"
    )
    return ForeignCamera(intrinsics, "Caltech toolbox", (note,))


def _intrinsics(
    camera: Mapping[str, Any], size: tuple[int, int], sigma: Floats | None, where: str
) -> Intrinsics:
    covariance = None if sigma is None else np.diag(sigma**2).tolist()
    plain = {k: v if isinstance(v, tuple) else float(v) for k, v in camera.items()}
    value = {**plain, "width_px": size[0], "height_px": size[1], "covariance": covariance}
    return validate(Intrinsics, value, where=where)


def _first(tree: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((tree[n] for n in names if n in tree), None)


def _numbers(value: Any, count: int | None) -> Floats | None:
    """``value`` as a flat array of finite numbers (``count`` of them), or None."""
    if isinstance(value, Mapping):
        value = value.get("data", value.get("val"))
    if value is None:
        return None
    try:
        flat = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError):
        return None
    if not flat.size or (count is not None and flat.size != count) or not np.isfinite(flat).all():
        return None
    return flat


def _five(lens: Floats | None, where: str) -> tuple[float, ...]:
    if lens is None:
        return (0.0,) * 5
    if lens.size > 5 and np.abs(lens[5:]).max() > 0:
        raise InputError(
            f"{where}: {lens.size} distortion coefficients; this model has five (k1 k2 p1 p2 k3)",
            hint="calibrate again without the rational, thin prism and tilted model",
        )
    return tuple(float(v) for v in np.pad(lens[:5], (0, max(0, 5 - lens.size))))


def _size(tree: Mapping[str, Any], where: str, size_px: tuple[int, int] | None) -> tuple[int, int]:
    width, height = _numbers(_first(tree, _WIDTH), 1), _numbers(_first(tree, _HEIGHT), 1)
    both = _numbers(_first(tree, _SIZE), 2)
    found = None
    if width is not None and height is not None:
        found = (int(width[0]), int(height[0]))
    elif both is not None:
        found = (int(both[0]), int(both[1]))
    if found is None and size_px is None:
        raise InputError(f"{where}: it does not say the image size", hint=_NO_SIZE)
    if found is not None and size_px is not None and found != size_px:
        raise InputError(
            f"{where}: made from images of {found[0]} x {found[1]} px, not {size_px[0]} x {size_px[1]}",
            hint="leave out --size-px",
        )
    size = found or size_px
    assert size is not None
    return size


def _check_model(tree: Mapping[str, Any], where: str) -> None:
    model = tree.get("distortion_model", tree.get("camera_model", ""))
    if isinstance(model, str) and model and model.lower() not in _MODELS:
        raise InputError(
            f"{where}: its distortion model is {model!r}, which is another one",
            hint="calibrate again with the five coefficients k1 k2 p1 p2 k3",
        )


def _tree(data: bytes, where: str) -> dict[str, Any]:
    """The document as nested dicts and lists. JSON by the standard library; YAML and XML by OpenCV."""
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: no calibration in text form, and no MATLAB file") from error
    if text.lstrip().startswith("{"):
        try:
            value = json.loads(text)
        except json.JSONDecodeError as error:
            raise InputError(f"{where}: not JSON ({error})") from error
        return _flat(value)
    if not text.lstrip().startswith(("%YAML", "<")):
        # Plain YAML, such as ROS writes; OpenCV insists on its own first line.
        text = f"%YAML:1.0\n---\n{_indented(text.removeprefix('---').lstrip())}"
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        tree = _node(root)
    except (cv2.error, SystemError) as error:
        raise InputError(
            f"{where}: neither YAML nor XML that OpenCV reads",
            hint="OpenCV, ROS and Caltech files are read",
        ) from error
    return _flat(tree) if isinstance(tree, dict) else {}


def _indented(text: str) -> str:
    """Lists as OpenCV wants them: a bracketed one in a line, the items of the others indented."""
    joined = re.sub(r"\[[^\[\]]*\]", lambda m: " ".join(m.group().split()), text)
    return re.sub(r"^( *)- ", r"\1  - ", joined, flags=re.MULTILINE)


def _flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of the document, and of a single level below where the top has no camera matrix."""
    if any(n in tree for n in _MATRIX):
        return dict(tree)
    inner: dict[str, Any] = {}
    for value in tree.values():
        if isinstance(value, Mapping):
            inner.update(value)
    return {**inner, **tree}


def _node(node: Any) -> Any:
    if node.isMap():
        return {key: _node(node.getNode(key)) for key in node.keys()}  # noqa: SIM118 (no iterator)
    if node.isSeq():
        return [_node(node.at(i)) for i in range(node.size())]
    if node.isInt() or node.isReal():
        value = float(node.real())
        return value if math.isfinite(value) else None
    return node.string() if node.isString() else None
