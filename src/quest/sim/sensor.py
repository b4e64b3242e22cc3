"""What a real camera would have made of a rendered clip: noise, blur and compression of colours, depth with holes.

A depth sensor with two eyes (a camera and a projector, or two cameras) measures disparity ``d = f b / z``: focal length
``f`` in its own pixels, baseline ``b``. From that follows how its depth fails:

* disparity comes in steps ``s``, so depth comes in steps of about ``s z^2 / (f b)``, and noise grows like ``z^2``;
* what the second eye, ``b`` to the right, does not see has no depth: a shadow to the *left* of what stands in front;
* matching windows straddle discontinuities: edges jitter and are torn, and noise is correlated between neighbours;
* little light comes back from surfaces seen at a grazing angle, from dark ones and, mirrored away, from shiny ones;
* beyond its range there is nothing.

Materials are not known here: dark and shiny are read off the picture's brightness. Missing depth is 0.

References:
    Khoshelham and Elberink (2012), Accuracy and Resolution of Kinect Depth Data: disparity steps of 1/8 px, f b.
    Nguyen, Izadi and Lovell (2012), Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking:
    axial noise 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2, its growth with the angle, lateral noise of 0.8 px.
    Handa, Whelan, McDonald and Davison (2014), A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM:
    lateral shifts, then noise and steps of disparity.
    Grunnet-Jepsen, Sweetser and Woodfill, Best-Known-Methods for Tuning Intel RealSense D400 Depth Cameras: depth
    error ``z^2 * subpixel / (f b)`` with a subpixel error of 0.08.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from quest.errors import ConfigError, InputError
from quest.types import Camera

_TORN = 0.015
"""Inverse depth that bends by this share of itself from pixel to pixel is a discontinuity."""
_GRAZING_RAD = (float(np.deg2rad(68.0)), float(np.deg2rad(86.0)))
"""Angles between the ray and the normal between which depth fades away."""
_DARK = 0.13
_SHINY = 0.97
_CORRELATED = 0.6
"""Share of the variance that neighbouring pixels have in common."""
_LASTING = 0.5
"""Share of the variance of where holes are that stays the same from frame to frame."""


@dataclass(frozen=True)
class DepthSensor:
    """A depth sensor with two eyes."""

    baseline_m: float
    """From the camera to its second eye, which is on its right."""
    focal_px: float
    """Its own focal length, in its own pixels."""
    step_px: float
    """Step of its disparity."""
    noise_m: float
    """Standard deviation of depth, metres, where it is best: ``noise_m + noise_per_m (z - best_m)^2``."""
    noise_per_m: float
    """Growth of that, per metre."""
    best_m: float
    """Depth from which on it grows."""
    slant_m: float
    """Further standard deviation ``slant_m / sqrt(z) * (a / (90 deg - a))^2`` at an angle ``a``."""
    lateral_px: float
    """Standard deviation of where it looks, in its own pixels."""
    range_m: tuple[float, float]
    """Nearest and farthest depth."""
    torn: float
    """How often a pixel at a discontinuity is a hole."""
    lost_dark: float
    """How often a black pixel is a hole."""
    lost_shiny: float
    """How often a white highlight is a hole."""

    def __post_init__(self) -> None:
        positive = (self.baseline_m, self.focal_px, self.step_px, *self.range_m)
        if not all(np.isfinite(positive)) or min(positive) <= 0 or self.range_m[0] >= self.range_m[1]:
            raise ConfigError(f"depth sensor: expected a positive baseline, focal length, step and range, got {self}")
        others = (self.noise_m, self.noise_per_m, self.best_m, self.slant_m, self.lateral_px)
        if not all(np.isfinite(others)) or min(others) < 0:
            raise ConfigError(f"depth sensor: expected noise of at least 0, got {self}")
        if not all(0 <= share <= 1 for share in (self.torn, self.lost_dark, self.lost_shiny)):
            raise ConfigError(f"depth sensor: expected shares of holes between 0 and 1, got {self}")

    def sigma_m(self, depth_m: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Standard deviation of depth on a surface that looks at the camera, before disparity is rounded."""
        return self.noise_m + self.noise_per_m * (depth_m - self.best_m) ** 2

    def step_m(self, depth_m: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Distance between neighbouring values of depth: ``step z^2 / (f b)``."""
        return self.step_px * depth_m**2 / (self.focal_px * self.baseline_m)


STRUCTURED_LIGHT = DepthSensor(
    baseline_m=0.075,
    focal_px=580.0,
    step_px=1 / 8,
    noise_m=0.0012,
    noise_per_m=0.0019,
    best_m=0.4,
    slant_m=0.0001,
    lateral_px=0.8,
    range_m=(0.4, 5.0),
    torn=0.45,
    lost_dark=0.5,
    lost_shiny=0.5,
)
"""Of the class of the first Kinect: a projected pattern of dots, 640 x 480."""

STEREO = DepthSensor(
    baseline_m=0.05,
    focal_px=430.0,
    step_px=1 / 32,
    noise_m=0.0,
    noise_per_m=0.08 / (430.0 * 0.05),
    best_m=0.0,
    slant_m=0.0001,
    lateral_px=1.5,
    range_m=(0.17, 10.0),
    torn=0.3,
    lost_dark=0.15,
    lost_shiny=0.35,
)
"""Of the class of the RealSense D435: two infrared cameras, 848 x 480, wide windows, 0.08 px of subpixel error."""


@dataclass(frozen=True)
class SensorModel:
    """What happens to colours and depth between the scene and the file."""

    depth: DepthSensor | None = None
    """The depth sensor, or None for depth as rendered."""
    rgb_noise: float = 0.0
    """Standard deviation of Gaussian noise, as a share of full scale."""
    blur_px: float = 0.0
    """Standard deviation of a Gaussian blur, pixels of the picture."""
    motion_blur_px: float = 0.0
    """Length of a straight smear in a direction that all frames share."""
    jpeg_quality: int | None = None
    """1 to 100, or None for no compression."""

    def __post_init__(self) -> None:
        if not 0 <= self.rgb_noise <= 1:
            raise ConfigError(f"sensor: expected RGB noise as a share of full scale, 0 to 1, got {self.rgb_noise}")
        if not (0 <= self.blur_px <= 50 and 0 <= self.motion_blur_px <= 50):
            raise ConfigError(
                f"sensor: expected blurs between 0 and 50 pixels, got {self.blur_px} and {self.motion_blur_px}"
            )
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ConfigError(f"sensor: expected a JPEG quality between 1 and 100 or None, got {self.jpeg_quality}")

    @property
    def keeps_rgb(self) -> bool:
        """Whether colours come out as they go in."""
        return not (self.rgb_noise or self.blur_px or self.motion_blur_px) and self.jpeg_quality is None


SENSORS = {
    "ideal": SensorModel(),
    "structured-light": SensorModel(STRUCTURED_LIGHT, rgb_noise=0.01),
    "stereo": SensorModel(STEREO, rgb_noise=0.01),
}
"""Sensors by name."""


def sense(
    rgb: UInt8[np.ndarray, "T H W 3"],
    depth_m: Float32[np.ndarray, "T H W"],
    model: SensorModel,
    rng: np.random.Generator,
    *,
    camera: Camera,
) -> tuple[UInt8[np.ndarray, "T H W 3"], Float32[np.ndarray, "T H W"]]:
    """A rendered clip as a sensor would have recorded it.

    A frame's result depends on the clip's seed, on the frame and on its number, not on other frames. What a sensor
    does not change comes back as the array that went in. Depth is along +z, 0 where missing. ``rng`` is always advanced
    by the same amount.

    Raises:
        InputError: colours, depth and camera are not of one size, or depth is negative or not finite.
    """
    size = (camera.height, camera.width)
    if rgb.shape != (*depth_m.shape, 3) or depth_m.shape[1:] != size:
        raise InputError(
            f"sensor: expected colours and depth of {size[1]} x {size[0]} pixels as the camera's, "
            f"got shapes {rgb.shape} and {depth_m.shape}"
        )
    if not np.isfinite(depth_m).all() or (depth_m < 0).any():
        raise InputError("sensor: expected finite depth >= 0 (0 where missing), got other values; mend the depth first")
    seed = int(rng.integers(2**63))
    sensed_depth = depth_m
    if model.depth is not None:
        recorder = _DepthRecorder(model.depth, camera, seed)
        frames = [
            recorder.record(depth, rgb[t], np.random.default_rng([seed, t, 0])) for t, depth in enumerate(depth_m)
        ]
        sensed_depth = np.stack(frames) if frames else depth_m
    if model.keeps_rgb:
        return rgb, sensed_depth
    direction = float(np.random.default_rng([seed, 2]).uniform(0, np.pi))
    sensed = [_record_rgb(frame, model, direction, np.random.default_rng([seed, t, 1])) for t, frame in enumerate(rgb)]
    return (np.stack(sensed) if sensed else rgb), sensed_depth


def _record_rgb(
    rgb: UInt8[np.ndarray, "H W 3"], model: SensorModel, direction_rad: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"]:
    rgb = np.ascontiguousarray(rgb)
    if model.blur_px:
        rgb = np.asarray(cv2.GaussianBlur(rgb, (0, 0), model.blur_px), dtype=np.uint8)
    if model.motion_blur_px:
        kernel = _smear(model.motion_blur_px, direction_rad)
        rgb = np.asarray(cv2.filter2D(rgb, -1, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.uint8)
    if model.rgb_noise:
        noise = rng.standard_normal(rgb.shape, dtype=np.float32)
        noise *= 255 * model.rgb_noise
        noise += rgb
        rgb = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
    if model.jpeg_quality is not None:
        _, data = cv2.imencode(".jpg", rgb[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, model.jpeg_quality))
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        rgb = np.ascontiguousarray(decoded[..., ::-1], dtype=np.uint8)
    return rgb


def _smear(length_px: float, direction_rad: float) -> Float32[np.ndarray, "N N"]:
    """Kernel of a straight motion; a length below a pixel hardly smears."""
    radius = int(np.ceil(length_px / 2))
    kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
    along = np.linspace(-length_px / 2, length_px / 2, 16 * radius + 1)
    x, y = radius + along * np.cos(direction_rad), radius + along * np.sin(direction_rad)
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
            weight = (1 - np.abs(x - column)) * (1 - np.abs(y - row))
            inside = (column < len(kernel)) & (row < len(kernel))
            np.add.at(kernel, (row[inside], column[inside]), weight[inside].astype(np.float32))
    return kernel / kernel.sum()


class _DepthRecorder:
    """One depth sensor with one camera."""

    def __init__(self, sensor: DepthSensor, camera: Camera, seed: int) -> None:
        self._sensor, self._camera = sensor, camera
        self._shape = camera.height, camera.width
        self._kept_by_brightness = _kept_by_brightness(sensor)
        self._lasting = self._field(np.random.default_rng([seed, 3]))
        self._x = np.broadcast_to(np.arange(camera.width, dtype=np.float32), self._shape)
        self._y = np.broadcast_to(np.arange(camera.height, dtype=np.float32)[:, None], self._shape)
        self._ray_x = (self._x + np.float32(0.5 - camera.cx)) / np.float32(camera.fx)
        self._ray_y = (self._y + np.float32(0.5 - camera.cy)) / np.float32(camera.fy)
        self._ray = np.sqrt(self._ray_x**2 + self._ray_y**2 + 1)

    def record(
        self, depth_m: Float32[np.ndarray, "H W"], rgb: UInt8[np.ndarray, "H W 3"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "H W"]:
        """What the sensor tells of one frame."""
        sensor, white = self._sensor, rng.standard_normal(self._shape, dtype=np.float32)
        field, shift_x, shift_y = self._field(rng), self._field(rng), self._field(rng)
        inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
        angle = self._angle_rad(inverse)
        holes = self._holes(inverse, angle, rgb, field, white)
        # Where it looks, it looks a little beside: edges jitter.
        pixels = sensor.lateral_px * self._camera.fx / sensor.focal_px
        looked = cv2.remap(
            depth_m,
            self._x + np.float32(pixels) * shift_x,
            self._y + np.float32(pixels) * shift_y,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )
        holes |= (depth_m == 0) | (looked == 0)
        looked = np.where(holes, np.float32(1), looked)
        angle = np.minimum(angle, _GRAZING_RAD[1])
        steep = angle / (np.pi / 2 - angle)
        sigma_m = sensor.sigma_m(looked) + np.float32(sensor.slant_m) * steep**2 / np.sqrt(looked)
        noise = np.float32(np.sqrt(1 - _CORRELATED)) * white + np.float32(np.sqrt(_CORRELATED)) * field
        unit = np.float32(sensor.focal_px * sensor.baseline_m)
        # d = f b / z and sigma_d = sigma_z f b / z^2; then whole steps.
        disparity = unit / looked * (1 + noise * sigma_m / looked)
        steps = np.rint(disparity / np.float32(sensor.step_px))
        sensed = unit / np.float32(sensor.step_px) / np.maximum(steps, 1)
        holes |= (steps < 1) | (sensed < sensor.range_m[0]) | (sensed > sensor.range_m[1])
        sensed[holes] = 0
        return sensed

    def _holes(
        self,
        inverse: Float32[np.ndarray, "H W"],
        angle_rad: Float32[np.ndarray, "H W"],
        rgb: UInt8[np.ndarray, "H W 3"],
        field: Float32[np.ndarray, "H W"],
        white: Float32[np.ndarray, "H W"],
    ) -> Bool[np.ndarray, "H W"]:
        sensor = self._sensor
        bend = np.maximum(*(np.abs(cv2.filter2D(inverse, -1, k, borderType=cv2.BORDER_REPLICATE)) for k in _BENDS))
        kept = 1 - np.float32(sensor.torn) * (bend > _TORN * inverse)
        low, high = _GRAZING_RAD
        kept *= 1 - np.clip((angle_rad - low) / (high - low), 0, 1)
        grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
        kept *= np.asarray(cv2.LUT(grey, self._kept_by_brightness))
        lasting = np.float32(np.sqrt(_LASTING)) * self._lasting + np.float32(np.sqrt(1 - _LASTING)) * field
        # The logistic function is the normal distribution's to 1 %: a share in [0, 1] out of a Gaussian field.
        share = 1 / (1 + np.exp(np.float32(-1.702) * lasting))
        return (share > kept) | self._shadow(inverse, white)

    def _shadow(
        self, inverse: Float32[np.ndarray, "H W"], white: Float32[np.ndarray, "H W"]
    ) -> Bool[np.ndarray, "H W"]:
        """What the second eye does not see: something nearer is in the way there.

        A shadow narrower than a pixel is there as often as it is wide.
        """
        height, width = self._shape
        shift = np.float32(self._camera.fx * self._sensor.baseline_m) * inverse
        pad = int(np.ceil(shift.max(initial=0.0))) + 2
        row = np.arange(height)[:, None] * (width + pad + 2)
        column = self._x - shift + pad
        left = np.floor(column).astype(np.int64)
        nearest = np.zeros(height * (width + pad + 2), np.float32)
        flat = shift.reshape(-1)
        np.maximum.at(nearest, (row + left).reshape(-1), flat)
        np.maximum.at(nearest, (row + left + 1).reshape(-1), flat)
        seen = nearest[row + np.rint(column).astype(np.int64)]
        return seen - shift > 0.75 + 0.2 * np.clip(white, -2, 2)

    def _angle_rad(self, inverse: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Angle between every pixel's ray and the normal; exact on planes, whose inverse depth is linear in pixels."""
        x, y = self._camera.fx * _slope(inverse, 1), self._camera.fy * _slope(inverse, 0)
        z = inverse - x * self._ray_x - y * self._ray_y
        cosine = inverse / np.maximum(np.sqrt(x * x + y * y + z * z) * self._ray, np.float32(1e-12))
        return np.arccos(np.clip(cosine, 0, 1))

    def _field(self, rng: np.random.Generator) -> Float32[np.ndarray, "H W"]:
        """A Gaussian field of unit variance that neighbouring pixels share: every second one, and between them."""
        height, width = self._shape
        coarse = rng.standard_normal((height // 2 + 1, width // 2 + 1), dtype=np.float32)
        fine = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
        # Every pixel is 3/4 of one and 1/4 of another in both directions.
        return np.asarray(fine[1 : 1 + height, 1 : 1 + width], dtype=np.float32) * np.float32(1.6)


def _slope(inverse: Float32[np.ndarray, "H W"], axis: int) -> Float32[np.ndarray, "H W"]:
    """Change from pixel to pixel; the smaller of both sides', so that no discontinuity counts as a steep surface."""
    step = np.diff(inverse, axis=axis)
    if step.shape[axis] == 0:
        return np.zeros_like(inverse)
    first, last = step.take([0], axis), step.take([-1], axis)
    before, after = np.concatenate((first, step), axis), np.concatenate((step, last), axis)
    return np.where(np.abs(before) < np.abs(after), before, after)


_BENDS = tuple(np.array([1, -2, 1], np.float32).reshape(shape) for shape in ((1, 3), (3, 1)))


def _kept_by_brightness(sensor: DepthSensor) -> Float32[np.ndarray, "256"]:
    """How often a pixel of a grey value has depth."""
    grey = np.arange(256) / 255
    dark = sensor.lost_dark * np.clip((_DARK - grey) / _DARK, 0, 1)
    shiny = sensor.lost_shiny * np.clip((grey - _SHINY) / (1 - _SHINY), 0, 1)
    return ((1 - dark) * (1 - shiny)).astype(np.float32)
