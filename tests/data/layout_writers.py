"""Recordings as the recorders and data sets of others leave them, written for tests."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from PIL import Image
from scipy.spatial.transform import Rotation

from quest.data.video import write_video
from quest.types import Camera

FRAMES, WIDTH, HEIGHT = 5, 640, 480
RNG = np.random.default_rng(1)
RGB = np.repeat(np.repeat(RNG.integers(0, 256, (FRAMES, 6, 8, 3)), 80, 1), 80, 2).astype(np.uint8)
MM = (1000 + 2 * np.arange(HEIGHT)[:, None] + np.arange(WIDTH)).astype(np.uint16)
MM[:40] = 0
MM[40:60] = 65535  # nothing seen, as 7-Scenes has it
DEPTH_M = np.where(MM == 65535, 0, MM / 1000)
CAMERA = Camera(520.0, 521.0, 320.5, 240.5, WIDTH, HEIGHT)
MATRIX = np.array([[520.0, 0, 320.0], [0, 521.0, 240.0], [0, 0, 1]])
STAMPS = 1305031452.79 + np.arange(FRAMES) / 25
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def world_from_cam() -> np.ndarray:
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler(
        "yx", np.stack((np.arange(FRAMES) * 0.1, np.full(FRAMES, 0.2)), -1)
    ).as_matrix()
    poses[:, :3, 3] = np.stack((np.arange(FRAMES) * 0.05, np.full(FRAMES, 0.3), np.full(FRAMES, -1.0)), -1)
    return poses


POSES = world_from_cam()


def png(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)


def numbers(path: Path, array: np.ndarray, **how: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, array, **how)  # pyright: ignore[reportArgumentType]


def exr(path: Path, depth_m: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": depth_m.astype(np.float32)}) as file:
        file.write(str(path))


def quaternions(poses: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(poses[:, :3, :3]).as_quat()


def tum(root: Path, name: str = "rgbd_dataset_own") -> Path:
    root = root / name
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for t, at_s in enumerate(STAMPS):
        for kind, seconds, picture in (("rgb", at_s, RGB[t]), ("depth", at_s + 0.011, MM * 5 * (MM < 65535))):
            if (kind, t) != ("depth", 3):  # a frame without depth
                png(root / kind / f"{seconds:.6f}.png", picture.astype(picture.dtype))
                lists[kind].append(f"{seconds:.6f} {kind}/{seconds:.6f}.png")
    for kind, lines in lists.items():
        (root / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    rows = np.column_stack((STAMPS, POSES[:, :3, 3], quaternions(POSES)))
    numbers(root / "groundtruth.txt", rows, fmt="%.9f", header="ground truth trajectory")
    return root


def pictures(root: Path, colours: str, depth: str) -> Path:
    """Colours and depth under names with the number of the frame in them."""
    for t in range(FRAMES):
        png(root / colours.format(t), RGB[t])
        png(root / depth.format(t), MM)
    return root


def pose_files(root: Path, name: str) -> None:
    for t in range(FRAMES):
        numbers(root / name.format(t), POSES[t])


def seven_scenes(root: Path) -> Path:
    pose_files(root, "frame-{:06d}.pose.txt")
    return pictures(root, "frame-{:06d}.color.png", "frame-{:06d}.depth.png")


def rscan(root: Path) -> Path:
    pose_files(root, "frame-{:06d}.pose.txt")
    for t in range(FRAMES):
        Image.fromarray(RGB[t]).save(root / f"frame-{t:06d}.color.jpg", quality=98)
        cv2.imwrite(str(root / f"frame-{t:06d}.depth.pgm"), MM[::4, ::4])
    lines = [f"m_{which}{side} = {n}" for which, size in (("color", (WIDTH, HEIGHT)), ("depth", (160, 120)))
             for side, n in zip(("Width", "Height"), size, strict=True)]  # fmt: skip
    for which, scale in (("Color", 1.0), ("Depth", 0.25)):
        whole = np.eye(4)
        whole[:2, :3] = MATRIX[:2] * scale
        lines.append(f"m_calibration{which}Intrinsic = {' '.join(map(str, whole.ravel()))} ")
    (root / "_info.txt").write_text("\n".join([*lines, "m_depthShift = 1000"]) + "\n")
    return root


def open3d(root: Path) -> Path:
    pictures(root, "color/{:06d}.png", "depth/{:06d}.png")
    fields = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": MATRIX.T.ravel().tolist(), "depth_scale": 1000.0}
    (root / "intrinsic.json").write_text(json.dumps(fields))
    with (root / "trajectory.log").open("w") as log:
        for t in range(FRAMES):
            log.write(f"{t} {t} {t + 1}\n" + "\n".join(" ".join(map(str, row)) for row in POSES[t]) + "\n")
    return root


def scannet(root: Path) -> Path:
    pictures(root, "color/{}.png", "depth/{}.png")
    pose_files(root, "pose/{}.txt")
    numbers(root / "pose" / "2.txt", np.full((4, 4), -np.inf))
    whole = np.eye(4)
    whole[:3, :3] = MATRIX
    for name in ("color", "depth"):
        numbers(root / "intrinsic" / f"intrinsic_{name}.txt", whole)
        numbers(root / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4))
    return root


def matrix_as_text(root: Path) -> Path:
    for t in range(FRAMES):
        (root / "rgb").mkdir(exist_ok=True)
        Image.fromarray(RGB[t]).save(root / "rgb" / f"{t}.webp", lossless=True)
        (root / "depth").mkdir(exist_ok=True)
        np.save(root / "depth" / f"{t}.npy", MM)
    numbers(root / "K.txt", MATRIX)
    return root


def record3d(root: Path) -> Path:
    for t in range(FRAMES):
        png(root / "EXR_RGBD" / "rgb" / f"{t}.png", RGB[t])
        exr(root / "EXR_RGBD" / "depth" / f"{t}.exr", np.where(DEPTH_M > 0, DEPTH_M, np.nan)[::4, ::4])
    poses = np.column_stack((quaternions(POSES @ GL_FROM_CV), POSES[:, :3, 3]))
    fields = {"w": WIDTH, "h": HEIGHT, "dw": 160, "dh": 120, "fps": 25, "K": MATRIX.T.ravel().tolist()}
    fields |= {"poses": poses.tolist(), "frameTimestamps": (STAMPS - STAMPS[0] + 0.5).tolist()}
    (root / "EXR_RGBD" / "metadata.json").write_text(json.dumps(fields))
    return root


def stray(root: Path) -> Path:
    write_video(root / "rgb.mp4", list(RGB), frames_per_s=25, crf=8)
    for t in range(FRAMES):
        png(root / "depth" / f"{t:06d}.png", MM[::4, ::4])
        png(root / "confidence" / f"{t:06d}.png", np.full((120, 160), 2, np.uint8))
    numbers(root / "camera_matrix.csv", MATRIX, delimiter=",")
    rows = np.column_stack((STAMPS, np.arange(FRAMES), POSES[:, :3, 3], quaternions(POSES)))
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    np.savetxt(root / "odometry.csv", rows, delimiter=", ", header=header, comments="")
    return root


def nerfstudio(root: Path) -> Path:
    pictures(root, "images/frame_{:05d}.png", "depths/frame_{:05d}.png")
    frames = []
    for t in range(FRAMES):
        paths = {"file_path": f"images/frame_{t:05d}.png", "depth_file_path": f"depths/frame_{t:05d}.png"}
        frames.append({**paths, "transform_matrix": (POSES[t] @ GL_FROM_CV).tolist()})
    fields = {"fl_x": 520.0, "fl_y": 521.0, "cx": 320.5, "cy": 240.5, "w": WIDTH, "h": HEIGHT, "k1": 0, "k2": 0}
    (root / "transforms.json").write_text(json.dumps({**fields, "camera_model": "OPENCV", "frames": frames[::-1]}))
    return root
