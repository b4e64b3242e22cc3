"""Follow entities in arrays of your own: colours, depth in metres and the camera's matrix, here those of the sample.

python examples/own_arrays.py
"""

from __future__ import annotations

import quest


def follow(tracker: quest.Tracker, sample: quest.Clip) -> quest.Tracks:
    """Tracks of the clip's arrays, given as one would give one's own."""
    rgb, depth_m = sample.rgb, sample.depth_m  # [T, H, W, 3] of uint8, or floats from 0 to 1; [T, H, W] in metres
    clip = quest.Clip.from_arrays(rgb, depth_m, sample.camera, fps=30)
    return tracker.track(clip, [quest.Query.semantic("knob", name="mine")])


if __name__ == "__main__":
    tracks = follow(quest.load(), quest.read("sample"))
    print(tracks)  # a line per query: how often it was seen, its joint, its state at the end
    print(tracks.uv_px[-1], tracks.point_world[-1], tracks.joints)
    tracks.save("outputs/own-arrays")  # tracks.parquet and joints.json
