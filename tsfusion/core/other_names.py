# SPDX-License-Identifier: MIT
"""Names that other libraries use (Open3D, VDBFusion, nerfstudio), and what to write here instead."""

from collections.abc import Iterable
from difflib import get_close_matches

_INVERSE = "T_world_camera, its inverse: T_world_camera=np.linalg.inv({name})"
_POSE = "T_world_camera, which takes a point of the camera to the world"

KEYFRAME = {
    **dict.fromkeys(("T_camera_world", "extrinsic", "extrinsics", "w2c", "world_to_camera"), _INVERSE),
    **dict.fromkeys(("pose", "T", "c2w", "camera_to_world", "transform", "T_world_sensor"), _POSE),
    **dict.fromkeys(("intrinsic", "K", "camera_matrix"), "intrinsics"),
    **dict.fromkeys(("rgb", "image", "colors"), "color, uint8 in the order BGR: color=rgb[..., ::-1]"),
    **dict.fromkeys(("scan", "cloud", "xyz"), "points, in the sensor's frame"),
    **dict.fromkeys(("timestamp", "stamp"), "timestamp_ns, an integer of nanoseconds"),
    **dict.fromkeys(("depth_max", "depth_trunc"), "max_range, a setting of Volume"),
}
_BAND = "min_support=N, max_support=N with N = sdf_trunc / voxel_size; by default the sensor's noise decides"
SETTINGS = {
    **dict.fromkeys(("sdf_trunc", "truncation", "trunc_voxel_multiplier"), _BAND),
    **dict.fromkeys(("voxel_length", "resolution"), "voxel_size, in metres"),
    **dict.fromkeys(("depth_max", "depth_trunc"), "max_range, in metres"),
    **dict.fromkeys(("color_type", "attr_names"), "color=True or color=False"),
    **dict.fromkeys(("block_count", "block_resolution"), "nothing: blocks are added by need"),
    "device": "arch: cpu, cuda or vulkan",
}
_MESH = "extract_mesh(), whose result has vertices, faces and save('room.glb')"
VOLUME = {
    **dict.fromkeys(("extract_triangle_mesh", "extract_surface_mesh", "get_mesh"), _MESH),
    **dict.fromkeys(("extract_point_cloud", "extract_voxel_point_cloud"), "extract_mesh().vertices"),
    **dict.fromkeys(("extract_vdb_grids", "write", "dump"), "save('map.tsf')"),
    **dict.fromkeys(("fuse", "add", "update", "insert", "push"), "integrate(keyframe)"),
    "prune": "extract_mesh(min_weight=…)",
    "reset": "a new Volume",
    "voxel_size": "config.voxel_size",
}


def instead(name: str, others: dict[str, str], known: Iterable[str]) -> str:
    """End of a message about an unknown name: `: write …` where it is known what was meant, else empty."""
    if name in others:
        return f": write {others[name].format(name=name)}"
    close = get_close_matches(name, known, n=1)
    return f": did you mean {close[0]}?" if close else ""
