"""Small recordings in others' formats, written as their own recorders write them, and what is in them.

content = make_content()
write_bag(tmp_path / "one.bag", content)
"""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from rsgen.geometry import se3
from rsgen.image_codecs import encode_png

COLOR_SIZE, DEPTH_SIZE = (40, 30), (32, 24)
COLOR_K, DEPTH_K = (31.0, 31.5, 19.25, 14.75), (25.0, 24.5, 15.75, 11.5)
COUNT = 5
COLOR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
FRAME = {"color": "camera_color_optical_frame", "depth": "camera_depth_optical_frame"}
T_COLOR_DEPTH = se3.exp(np.array([0.0148, 0.0002, -0.0004, 0.004, -0.007, 0.002]))
T_IMU_DEPTH = se3.exp(np.array([0.006, -0.005, -0.012, 0.02, 0.01, -0.03]))


@dataclass(frozen=True)
class Content:
    """Images and stamps of a recording; poses (n, 4, 4): T_world_color at colour's stamps."""

    colors: np.ndarray
    units: np.ndarray
    color_ns: tuple[int, ...]
    depth_ns: tuple[int, ...]
    poses: np.ndarray


def make_content(seed: int = 0) -> Content:
    """Noise; depth has holes, the two streams are 7 ms apart."""
    rng = np.random.default_rng(seed)
    colors = rng.integers(0, 256, (COUNT, COLOR_SIZE[1], COLOR_SIZE[0], 3), dtype=np.uint8)
    units = rng.integers(300, 9000, (COUNT, DEPTH_SIZE[1], DEPTH_SIZE[0]), dtype=np.uint16)
    units[:, :3, :5] = 0
    color_ns = tuple(1_700_000_000_123_456_789 + 33_366_700 * k for k in range(COUNT))
    poses = np.stack([se3.exp(0.1 * k * np.array([1.0, -2.0, 0.5, 0.3, 0.2, -0.4])) for k in range(COUNT)])
    return Content(colors, units, color_ns, tuple(ns + 7_000_000 for ns in color_ns), poses)


@cache
def _store(is_ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


class Talker:
    """Messages of ROS 1 or 2, for `rosbags`' writers."""

    def __init__(self, is_ros1: bool) -> None:
        self.is_ros1 = is_ros1
        self.store = _store(is_ros1)

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind.replace("/", "/msg/")](**fields)

    def bytes(self, kind: str, message: Any) -> bytes:
        write = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        return bytes(write(message, kind.replace("/", "/msg/")))

    def header(self, ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.is_ros1 else {}))

    def image(self, ns: int, frame: str, pixels: np.ndarray, encoding: str, padding: int = 0) -> Any:
        """padding: bytes after each line."""
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).reshape(height, -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        return self.make(
            "sensor_msgs/Image", header=self.header(ns, frame), height=height, width=width, encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def compressed(self, ns: int, frame: str, data: bytes, format: str) -> Any:
        return self.make(
            "sensor_msgs/CompressedImage", header=self.header(ns, frame), format=format,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def info(self, frame: str, size: tuple[int, int], K: tuple[float, ...], model: str, D: list[float]) -> Any:
        matrix = np.array([K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1.0])
        P = np.insert(matrix, [3, 6, 9], 0.0)
        names = "DKRP" if self.is_ros1 else "dkrp"
        values = dict(zip(names, (np.array(D), matrix, np.eye(3).ravel(), P), strict=True))
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/CameraInfo", header=self.header(0, frame), width=size[0], height=size[1],
            distortion_model=model, binning_x=0, binning_y=0, roi=roi, **values,
        )  # fmt: skip

    def transform(self, T: np.ndarray) -> Any:
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        rotation = self.make("geometry_msgs/Quaternion", **dict(zip("xyzw", map(float, q), strict=True)))
        translation = self.make("geometry_msgs/Vector3", **dict(zip("xyz", map(float, T[:3, 3]), strict=True)))
        return self.make("geometry_msgs/Transform", translation=translation, rotation=rotation)

    def tf(self, edges: list[tuple[str, str, np.ndarray]]) -> Any:
        stamped = [
            self.make(
                "geometry_msgs/TransformStamped",
                header=self.header(0, parent),
                child_frame_id=child,
                transform=self.transform(T),
            )
            for parent, child, T in edges
        ]
        return self.make("tf2_msgs/TFMessage", transforms=stamped)

    def imu(self, ns: int, gyro: tuple[float, ...], accel: tuple[float, ...]) -> Any:
        vector = lambda v: self.make("geometry_msgs/Vector3", x=v[0], y=v[1], z=v[2])  # noqa: E731
        zeros = np.zeros(9)
        return self.make(
            "sensor_msgs/Imu", header=self.header(ns, "imu"), angular_velocity=vector(gyro),
            orientation=self.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            linear_acceleration=vector(accel), orientation_covariance=zeros, angular_velocity_covariance=zeros,
            linear_acceleration_covariance=zeros,
        )  # fmt: skip


Spoken = list[tuple[str, str, int, bytes]]
"""Topic, type, time of recording in ns, bytes."""


def write_spoken(path: Path, talker: Talker, spoken: Spoken, storage: str = "") -> Path:
    """A ROS 1 bag, or a ROS 2 one with storage sqlite3 or mcap, or only its one file if the path ends like that."""
    if talker.is_ros1:
        writer: Any = Writer1(path)
        if storage:
            writer.set_compression(getattr(Writer1.CompressionFormat, storage.upper()))
    else:
        folder = path.with_suffix(f"{path.suffix}.folder") if path.suffix in (".db3", ".mcap") else path
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(folder, version=9, storage_plugin=plugin)
        if storage == "mcap":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, ns, data in spoken:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind.replace("/", "/msg/"), typestore=talker.store)
            writer.write(connections[topic], ns, data)
    if not talker.is_ros1 and folder != path:
        next(folder.glob(f"*{path.suffix}")).rename(path)
    return path


def speak(talker: Talker, content: Content, **change: Any) -> Spoken:
    """What realsense-ros records: rgb8 colour, 16UC1 depth, camera_info, tf_static by way of a third frame, an IMU.

    change: color(k, ns), depth(k, ns): other messages, as (type, message); color_topic, depth_topic; color_info,
    depth_info: (model, D); tf: edges; stamped: False for headers without stamps.
    """
    color_topic, depth_topic = change.get("color_topic", COLOR), change.get("depth_topic", DEPTH)
    stamped = change.get("stamped", True)
    color: Callable[[int, int], tuple[str, Any]] = change.get(
        "color", lambda k, ns: ("sensor_msgs/Image", talker.image(ns, FRAME["color"], content.colors[k], "rgb8"))
    )
    depth: Callable[[int, int], tuple[str, Any]] = change.get(
        "depth", lambda k, ns: ("sensor_msgs/Image", talker.image(ns, FRAME["depth"], content.units[k], "16UC1"))
    )
    link = se3.exp(np.array([0.1, 0.2, 0.0, 0.5, -0.5, 0.5]))
    edges = change.get(
        "tf", [("link", FRAME["depth"], link), ("link", FRAME["color"], link @ se3.inverse(T_COLOR_DEPTH))]
    )
    start = content.color_ns[0] + 10**6
    spoken: Spoken = []
    for topic, frame, size, K, lens in (
        (color_topic, "color", COLOR_SIZE, COLOR_K, change.get("color_info", ("plumb_bob", [0.0] * 5))),
        (depth_topic, "depth", change.get("depth_size", DEPTH_SIZE), change.get("depth_K", DEPTH_K),
         change.get("depth_info", ("plumb_bob", [0.0] * 5))),
    ):  # fmt: skip
        parent = topic.split("/image")[0]
        info = talker.info(FRAME[frame], size, K, *lens)
        spoken.append(
            (f"{parent}/camera_info", "sensor_msgs/CameraInfo", start, talker.bytes("sensor_msgs/CameraInfo", info))
        )
    if edges:
        spoken.append(("/tf_static", "tf2_msgs/TFMessage", start, talker.bytes("tf2_msgs/TFMessage", talker.tf(edges))))
    for k in range(COUNT):
        for make, stamps, topic in ((color, content.color_ns, color_topic), (depth, content.depth_ns, depth_topic)):
            kind, message = make(k, stamps[k] if stamped else 0)
            spoken.append((topic, kind, stamps[k] + 5_000_000, talker.bytes(kind, message)))
        imu = talker.imu(content.color_ns[k], (0.1, 0.2, 0.3 + k), (0.0, -9.81, k / 2))
        spoken.append(
            ("/camera/imu", "sensor_msgs/Imu", content.color_ns[k] + 1000, talker.bytes("sensor_msgs/Imu", imu))
        )
    return spoken + list(change.get("more", ()))


def write_realsense(path: Path, content: Content, unit: float = 0.001) -> Path:
    """As librealsense's recorder does: frame_id "1", the unit of depth after each image, tf to a reference."""
    talker = Talker(True)
    spoken: Spoken = []

    def say(topic: str, kind: str, ns: int, message: Any, rest: bytes = b"") -> None:
        spoken.append((topic, kind, ns, talker.bytes(kind, message) + rest))

    T_depth_reference = se3.exp(np.array([0.01, 0.0, 0.02, 0.02, 0.01, 0.0]))
    prefixes = {"depth": "/device_0/sensor_0/Depth_0", "color": "/device_0/sensor_1/Color_0"}
    say("/device_0/info", "diagnostic_msgs/KeyValue", 1,
        talker.make("diagnostic_msgs/KeyValue", key="Name", value="Intel RealSense D435"))  # fmt: skip
    for name, size, K, T in (
        ("depth", DEPTH_SIZE, DEPTH_K, T_depth_reference),
        ("color", COLOR_SIZE, COLOR_K, T_COLOR_DEPTH @ T_depth_reference),
    ):
        info = talker.info("", size, K, "Inverse Brown Conrady", [0.0] * 5)
        say(f"{prefixes[name]}/info/camera_info", "sensor_msgs/CameraInfo", 1, info)
        say(f"{prefixes[name]}/tf/1", "geometry_msgs/Transform", 1, talker.transform(T))
    motion = talker.transform(T_IMU_DEPTH @ T_depth_reference)
    say("/device_0/sensor_2/Gyro_0/tf/1", "geometry_msgs/Transform", 1, motion)
    for k in range(COUNT):
        for name, ns, pixels, encoding, units in (
            ("depth", content.depth_ns[k], content.units[k], "mono16", unit),
            ("color", content.color_ns[k], content.colors[k], "rgb8", 0.0),
        ):
            at = 50_000_000 * k + (1000 if name == "depth" else 2000)
            image = talker.image(ns, "1", pixels, encoding)
            say(f"{prefixes[name]}/image/data", "sensor_msgs/Image", at, image, struct.pack("<f", units))
            pair = talker.make("diagnostic_msgs/KeyValue", key="timestamp_domain", value="Hardware Clock")
            say(f"{prefixes[name]}/image/metadata", "diagnostic_msgs/KeyValue", at, pair)
        for name, offset in (("Gyro", 0), ("Accel", 3_000_000)):
            sample = talker.imu(content.color_ns[k] + offset, (0.5, 0.0, float(k)), (0.0, float(k), 9.0))
            say(f"/device_0/sensor_2/{name}_0/imu/data", "sensor_msgs/Imu", 50_000_000 * k + 3000, sample)
    return write_spoken(path, talker, spoken)


def write_realsense_db3(path: Path, content: Content) -> Path:
    """As librealsense 2.59 does: PNG, texts, and stamps only in the metadata."""
    talker = Talker(False)
    spoken: Spoken = []

    def text(topic: str, ns: int, said: str) -> None:
        message = talker.make("std_msgs/String", data=said)
        spoken.append((topic, "std_msgs/String", ns, talker.bytes("std_msgs/String", message)))

    text("/device_0/sensor_0/option/Depth_Units/value", 0, "0.001000")
    for name, size, K, T in (("Depth", DEPTH_SIZE, DEPTH_K, np.eye(4)), ("Color", COLOR_SIZE, COLOR_K, T_COLOR_DEPTH)):
        prefix = f"/device_0/sensor_{int(name == 'Color')}/{name}_0"
        R, t = T[:3, :3].T.ravel().tolist(), T[:3, 3].tolist()
        text(f"{prefix}/tf/ref_1", 0, f"rotation={','.join(map(repr, R))};translation={','.join(map(repr, t))}")
        for k in range(COUNT):
            at, taken = 50_000_000 * k + 1934, content.depth_ns[k] if name == "Depth" else content.color_ns[k]
            if name == "Depth":
                data, format, transport = (
                    bytes(12) + encode_png(content.units[k]),
                    "16UC1; compressedDepth png",
                    "Depth",
                )
            else:
                data, format, transport = encode_png(content.colors[k]), "rgb8; png compressed bgr8", ""
            image = talker.compressed(at, name, data, format)
            kind = "sensor_msgs/CompressedImage"
            spoken.append((f"{prefix}/image/data/compressed{transport}", kind, at, talker.bytes(kind, image)))
            text(f"{prefix}/image/metadata", at, f"Frame number={k};timestamp={taken / 10**6:.6f};depth_units=0.001;")
            info = talker.info(name, size, K, "plumb_bob", [0.0] * 5)
            kind = "sensor_msgs/CameraInfo"
            spoken.append((f"{prefix}/image/camera_info", kind, at, talker.bytes(kind, info)))
    return write_spoken(path, talker, spoken, "sqlite3")


def jpeg(pixels: np.ndarray) -> bytes:
    """JPEG of RGB pixels."""
    return bytes(cv2.imencode(".jpg", pixels[..., ::-1])[1].tobytes())


def write_sens(path: Path, content: Content, stamped: bool = True) -> Path:
    """ScanNet's format; the pose of frame 1 is lost."""
    matrix = lambda K: [K[0], 0, K[2], 0, 0, K[1], K[3], 0, 0, 0, 1, 0, 0, 0, 0, 1]  # noqa: E731
    eye, name = np.eye(4).ravel().tolist(), b"StructureSensor"
    out = struct.pack("<IQ", 4, len(name)) + name
    extrinsic = T_COLOR_DEPTH.ravel().tolist()
    out += struct.pack("<64f2i4IfQ", *matrix(COLOR_K), *eye, *matrix(DEPTH_K), *extrinsic, 2, 1,
                       *COLOR_SIZE, *DEPTH_SIZE, 1000.0, COUNT)  # fmt: skip
    for k in range(COUNT):
        pose = np.full(16, -np.inf) if k == 1 else (content.poses[k] @ T_COLOR_DEPTH).ravel()
        color, depth = jpeg(content.colors[k]), zlib.compress(content.units[k].tobytes())
        stamps = [ns // 1000 % 10**12 if stamped else 0 for ns in (content.color_ns[k], content.depth_ns[k])]
        out += struct.pack("<16f4Q", *pose, *stamps, len(color), len(depth)) + color + depth
    path.write_bytes(out)
    return path


def arkit_pose(T_world_camera: np.ndarray) -> list[float]:
    """qx qy qz qw x y z of ARKit's camera: y up, looking along −z."""
    T = T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    return [*Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), *T[:3, 3].tolist()]


def stored_lzfse(data: bytes) -> bytes:
    """A stream of LZFSE that is stored as it is: one block bvx-, and the end."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_r3d(path: Path, content: Content, **change: Any) -> Path:
    """Record3D's zip; intrinsics change from frame to frame. change: entries of the metadata."""
    meta = {
        "w": COLOR_SIZE[0], "h": COLOR_SIZE[1], "dw": 20, "dh": 15, "fps": 60, "cameraType": 1,
        "K": [COLOR_K[0], 0, 0, 0, COLOR_K[1], 0, COLOR_K[2], COLOR_K[3], 1],
        "frameTimestamps": [k / 60 for k in range(COUNT)], "poses": [arkit_pose(T) for T in content.poses],
        "perFrameIntrinsicCoeffs": [[COLOR_K[0] + 0.1 * k, *COLOR_K[1:]] for k in range(COUNT)],
    } | change  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        put = lambda name, data: archive.writestr(zipfile.ZipInfo(name), data)  # noqa: E731 - of 1980, not of now
        put("metadata", json.dumps(meta))
        for k in range(COUNT):
            z = content.units[k, :15, :20].astype(np.float32) / 1000
            put(f"rgbd/{k}.jpg", jpeg(content.colors[k]))
            put(f"rgbd/{k}.depth", stored_lzfse(z.tobytes()))
            put(f"rgbd/{k}.conf", stored_lzfse(np.full((15, 20), 2, np.uint8).tobytes()))
        put("../outside.txt", "x")
        put("/absolute.txt", "x")
    return path


def write_stray(root: Path, content: Content, per_frame: bool = True) -> Path:
    """Stray Scanner's folder; half of the confidence is low."""
    for name in ("depth", "confidence"):
        (root / name).mkdir(parents=True)
    video = cv2.VideoWriter(str(root / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60.0, COLOR_SIZE)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if per_frame else "")]
    for k in range(COUNT):
        video.write(np.full((COLOR_SIZE[1], COLOR_SIZE[0], 3), 40 * k + 30, np.uint8))
        (root / "depth" / f"{k:06d}.png").write_bytes(encode_png(content.units[k, :15, :20].copy()))
        sure = np.repeat(np.array([[0, 2]], np.uint8), 10, axis=1).repeat(15, axis=0)
        (root / "confidence" / f"{k:06d}.png").write_bytes(bytes(cv2.imencode(".png", sure)[1].tobytes()))
        T = content.poses[k]
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        own = [COLOR_K[0] + 0.1 * k, *COLOR_K[1:]] if per_frame else []
        lines.append(", ".join(map(repr, [100.0 + k / 60, *map(float, T[:3, 3]), *map(float, q), *own])))
        stamp, *rest = lines[-1].split(", ")
        lines[-1] = ", ".join([stamp, f"{k:06d}", *rest])
    video.release()
    (root / "odometry.csv").write_text("\n".join([*lines, ""]))
    K = f"{COLOR_K[0]}, 0.0, {COLOR_K[2]}\n0.0, {COLOR_K[1]}, {COLOR_K[3]}\n0.0, 0.0, 1.0\n"
    (root / "camera_matrix.csv").write_text(K)
    imu = ["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", "100.0, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3"]
    (root / "imu.csv").write_text("\n".join([*imu, "100.01, 1.5, 2.0, 3.0, 0.1, 0.2, 0.3", ""]))
    return root
