"""Follow entities in frames that arrive one by one, as they would from a camera."""

from __future__ import annotations

import quest
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.tracks import describe_joint


def main() -> None:
    """Discover the handles of the sample clip; print where the first one goes, on which joint, and every alarm."""
    clip = read_recording(sample_folder())  # stands in for a camera
    stream = quest.load("quest-s16").stream(clip.camera)  # no queries: follow what is found in the first frame
    stream.on_alarm(lambda alarm: print(f"{alarm.stamp_s:5.2f} s  {alarm.name} is probably lost: {alarm.reason}"))
    for t in range(len(clip)):
        frame = clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        if t % 15 == 0 and state.names:
            x, y, z = state.point_world[0]
            joint, words = state.joint[0], "no joint yet"
            if joint is not None:
                words = describe_joint(joint.kind.value, joint.lower, joint.upper, q=float(state.q[0]))
            print(f"{frame.stamp_s:5.2f} s  {state.names[0]}  {x:.3f} {y:.3f} {z:.3f} m  {state.state[0]}  {words}")


if __name__ == "__main__":
    main()
