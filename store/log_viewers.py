"""What Foxglove and Rerun can show of a calibration: protobuf CameraCalibration and FrameTransform.

turnscan itself never reads these messages back: the truth is the /calibration event beside them.
"""

from __future__ import annotations

import math

from ..schemas.calibration import Intrinsics, TurntableAxis


def camera_calibration_message(camera: Intrinsics, t_ns: int, camera_id: str) -> bytes:
    """A serialised foxglove.CameraCalibration. Viewers know no skew: it stands in K alone."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    out = CameraCalibration(
        frame_id=camera_id,
        width=camera.width_px,
        height=camera.height_px,
        distortion_model="plumb_bob",
        D=camera.distortion,
        K=[
            *(camera.fx_px, camera.fx_px * camera.skew, camera.cx_px),
            *(0.0, camera.fy_px, camera.cy_px),
            *(0.0, 0.0, 1.0),
        ],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[
            *(camera.fx_px, 0.0, camera.cx_px, 0.0),
            *(0.0, camera.fy_px, camera.cy_px, 0.0),
            *(0.0, 0.0, 1.0, 0.0),
        ],
    )
    out.timestamp.FromNanoseconds(t_ns)
    return out.SerializeToString(deterministic=True)


def frame_transform_message(axis: TurntableAxis, t_ns: int, camera_id: str) -> bytes:
    """A serialised foxglove.FrameTransform: the pose of turntable space in camera space, in m."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    out = FrameTransform(parent_frame_id=camera_id, child_frame_id="turntable")
    out.timestamp.FromNanoseconds(t_ns)
    out.translation.x, out.translation.y, out.translation.z = (a / 1000.0 for a in axis.point_mm)
    q = _quaternion(axis.camera_from_turntable())
    out.rotation.x, out.rotation.y, out.rotation.z, out.rotation.w = q
    return out.SerializeToString(deterministic=True)


def _quaternion(columns: tuple[tuple[float, ...], ...]) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a rotation given by its columns (Shepperd 1978, the stable branches)."""
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = columns
    trace = m00 + m11 + m22
    if trace > 0:
        s = math.sqrt(trace + 1.0) * 2
        return ((m21 - m12) / s, (m02 - m20) / s, (m10 - m01) / s, s / 4)
    if m00 >= m11 and m00 >= m22:
        s = math.sqrt(1.0 + m00 - m11 - m22) * 2
        return (s / 4, (m01 + m10) / s, (m02 + m20) / s, (m21 - m12) / s)
    if m11 >= m22:
        s = math.sqrt(1.0 + m11 - m00 - m22) * 2
        return ((m01 + m10) / s, s / 4, (m12 + m21) / s, (m02 - m20) / s)
    s = math.sqrt(1.0 + m22 - m00 - m11) * 2
    return ((m02 + m20) / s, (m12 + m21) / s, s / 4, (m10 - m01) / s)
