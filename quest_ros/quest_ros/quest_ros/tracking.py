"""The node without ROS: messages come in, answers go out as messages.

Pictures, poses and requests may come from several threads; one thread calls :meth:`Tracking.step`. What is wrong with a
message is told in the diagnostics, and never raised.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from quest.data.registration import Rig
from quest.data.ros_frames import camera_of
from quest.data.ros_images import depth_of, header_ns, rgb_of
from quest.data.transforms import STALE_S, Transforms, frame_name
from quest.errors import InputError, QuestError, RecordingError
from quest.track import Stream, StreamState, Tracker
from quest.types import Query, State
from quest.wording import counted
from quest_ros.answers import Place, Status, Types, diagnostics_of, markers_of, statuses_of, tracks_of
from quest_ros.inbox import Inbox, Sent
from quest_ros.settings import Settings, label_query, point_query

SILENT_S = 2.0
"""After how long without pictures the diagnostics say so."""


class Notice(NamedTuple):
    """A line for the log; its level is ``INFO``, ``WARN`` or ``ERROR``."""

    level: str
    text: str


class Answer(NamedTuple):
    """What is to be published about a picture."""

    tracks: Any
    """quest_msgs/Tracks."""
    markers: Any
    """visualization_msgs/MarkerArray."""


def _service(ask: Callable[[Tracking, Stream, Any, Any], str]) -> Callable[[Tracking, Any, Any], Any]:
    """A service that changes the stream: what is said, or the error, becomes words in the response."""

    @wraps(ask)
    def answer(self: Tracking, request: Any, response: Any) -> Any:
        if hasattr(response, "query"):
            response.query = -1
        with self._tracking:
            try:
                if self._stream is None:
                    raise InputError("no picture has been tracked yet; ask again when there is one")
                response.message = ask(self, self._stream, request, response)
                response.success = True
            except QuestError as error:
                response.success, response.message = False, str(error)
        return response

    return answer


class Tracking:
    """Tracks what comes on one camera's topics.

    Args:
        tracker: follows what is asked for.
        settings: what the node is told.
        types: gives the classes of messages.
        name: of the node, in the diagnostics.
        topic: of the colours, in messages; a name with ``rect`` in its last part has rectified pictures.
    """

    def __init__(
        self, tracker: Tracker, settings: Settings, types: Types, *, name: str = "quest", topic: str = "image"
    ) -> None:
        if settings.threshold:
            tracker.config = replace(tracker.config, threshold=settings.threshold)
        self._tracker, self._settings, self._types = tracker, settings, types
        self._name, self._topic = name, topic
        self._world = frame_name(settings.world_frame)
        self._coming = Lock()
        """Of what comes: pictures, poses and camera_info."""
        self._inbox = Inbox(depth=settings.use_depth, tolerance_ns=round(settings.sync_s * 1e9), posed=self._posed)
        self._transforms, self._static = Transforms(), {}
        self._info: Any = None
        self._frame_id = ""
        self._jumped: str | None = None
        self._came_ns: int | None = None
        self._late = 0
        self._tracking = Lock()
        """Of the stream, for steps and requests."""
        self._stream: Stream | None = None
        self._rig: Rig | None = None
        self._streams = self._tracked = self._refused = 0
        self._state: StreamState | None = None
        self._shown: list[tuple[str, int]] = []
        self._notices: list[Notice] = []
        self._problem = ""
        self._doubts: tuple[str, ...] = ()
        self._told: list[tuple[str, str]] = []

    def take_colours(self, message: Any, now_ns: int) -> None:
        """Take an Image or CompressedImage of colours; ``now_ns`` is the time by the node's clock."""
        with self._coming:
            self._came_ns, self._frame_id = now_ns, frame_name(message.header.frame_id)
            back_ns = self._inbox.colours(Sent(header_ns(message) or now_ns, message))
            if back_ns:
                self._jumped = f"time jumped back by {back_ns * 1e-9:.1f} s"
                self._transforms = Transforms()  # of what moves nothing holds any more
                for static in self._static.values():
                    self._transforms.add(static, static=True)

    def take_depth(self, message: Any, now_ns: int) -> None:
        """Take an Image or CompressedImage of depth."""
        with self._coming:
            self._inbox.depth(Sent(header_ns(message) or now_ns, message))

    def take_info(self, message: Any) -> None:
        """Take the CameraInfo of the colours."""
        with self._coming:
            self._info = message

    def take_transforms(self, message: Any, now_ns: int, *, static: bool) -> None:
        """Take a TFMessage; static transforms hold throughout."""
        with self._coming:
            self._transforms.add(message, static=static, log_ns=now_ns)
            if static:
                self._static[tuple(each.child_frame_id for each in message.transforms)] = message

    def step(self) -> Answer | None:
        """Track the newest picture that is ready; None if none is, or if it cannot be used."""
        with self._coming:
            taken = self._inbox.take()
            if taken is None:
                return None
            info, jumped, self._jumped = self._info, self._jumped, None
            late, self._late = self._inbox.late - self._late, self._inbox.late
        doubts = [f"late: {counted(late, 'picture')} older than the one before, left out"] if late else []
        with self._tracking:
            if jumped is not None and self._stream is not None:
                self._end(jumped)
            try:
                answer = self._track(*taken, info, doubts)
            except QuestError as error:
                self._refuse(str(error))
            except Exception as error:  # whatever it is, the next picture may be better
                self._refuse(f"{type(error).__name__}: {error}", traceback.format_exc())
            else:
                self._problem = ""
                self._doubt(tuple(doubts))
                return answer
        return None

    def _track(self, colours: Sent, depth: Sent | None, info: Any, doubts: list[str]) -> Answer:
        """The answer to a picture; what is less than it could be is added to ``doubts``.

        Raises:
            QuestError: the picture cannot be used.
        """
        rgb = rgb_of(colours.message, f"picture of {self._topic}")
        rig = self._rig_for(rgb, info, doubts)
        rgb, depth_m = rig.rgb(rgb), self._depth_of(rig, colours, depth, doubts)
        pose = self._pose_at(colours, doubts)
        stream = self._stream or self._begin(rig)
        if not header_ns(colours.message):
            doubts.append("headers have no time: that of arrival is used")
        try:
            state = stream.step(rgb, depth_m, colours.stamp_ns * 1e-9, pose)
        except InputError as error:
            if depth_m is None:
                raise
            doubts.append(f"depth is not used: {error}")
            state = stream.step(rgb, None, colours.stamp_ns * 1e-9, pose)
        self._tracked += 1
        self._tell(state)
        return self._answer(stream, state, colours)

    def _answer(self, stream: Stream, state: StreamState, colours: Sent) -> Answer:
        place = Place(colours.stamp_ns, self._world, None)
        if not self._world:
            moved = np.eye(4) if state.cam_from_world is None else state.cam_from_world
            place = Place(colours.stamp_ns, frame_name(colours.message.header.frame_id), moved)
        counts = {"stream": self._streams - 1, "frame": stream.frame - 1, "dropped": self._inbox.dropped}
        markers = markers_of(self._types, state, place, self._settings.marker_m, self._shown)
        deleted = self._types("visualization_msgs/msg/Marker").DELETE
        self._shown = [(marker.ns, marker.id) for marker in markers.markers if marker.action != deleted]
        return Answer(tracks_of(self._types, state, place, **counts), markers)

    def _rig_for(self, rgb: np.ndarray, info: Any, doubts: list[str]) -> Rig:
        """The camera of a picture; the stream ends if the pictures have another size, and camera_info says so too.

        Raises:
            InputError: no camera is known: camera_info has not come, or is not of such pictures.
        """
        size, running = rgb.shape[:2], self._rig
        if running is not None and (running.camera.height, running.camera.width) != size:
            running = None
        try:
            if info is None:
                raise InputError("no camera_info has come: check its topic, and that it is of the colours")
            camera, lens = camera_of(info, self._topic, size, self._topic)
            if (camera.height, camera.width) != size:
                raise InputError(
                    f"pictures of {self._topic} are {size[1]} x {size[0]}, but camera_info is for {camera.width} x "
                    f"{camera.height}; expected the camera_info of the colours"
                )
            rig = Rig(camera, lens)
        except InputError as error:
            if running is None:
                raise
            doubts.append(f"camera_info is not used: {error}")
            return running
        if running is None:
            if self._rig is not None:
                self._end(f"pictures are {size[1]} x {size[0]} now")
            self._rig = running = rig
        if not np.allclose(running.camera.matrix, rig.camera.matrix) or running.distortion != rig.distortion:
            doubts.append("camera_info changes on the way: the first of the stream is used")
        return running

    def _depth_of(self, rig: Rig, colours: Sent, depth: Sent | None, doubts: list[str]) -> np.ndarray | None:
        settings = self._settings
        if depth is None:
            if settings.use_depth:
                doubts.append(f"no depth within {settings.sync_s:g} s of the colours")
            return None
        frames = [frame_name(sent.message.header.frame_id) for sent in (colours, depth)]
        if frames[0] != frames[1]:
            doubts.append(f"depth is of {frames[1]!r}, colours of {frames[0]!r}: expected depth registered to them")
        try:
            return rig.depth(depth_of(depth.message, "picture of depth", scale_m=settings.depth_scale_m or None))
        except InputError as error:
            doubts.append(f"depth is not used: {error}")
            return None

    def _posed(self, stamp_ns: int) -> bool:
        """Whether the camera's pose at a time is known between two transforms, or is not wanted."""
        try:
            return not self._world or self._transforms.gap(self._frame_id, self._world, stamp_ns) == 0
        except RecordingError:  # a ring, which is told when the picture is tracked
            return True

    def _pose_at(self, colours: Sent, doubts: list[str]) -> np.ndarray | None:
        """``cam_from_world`` of a picture; None if the tracker is to estimate it.

        Raises:
            InputError: the stream has to begin with a pose, and has none.
        """
        if not self._world:
            return None
        camera = frame_name(colours.message.header.frame_id)
        with self._coming:
            pose = self._transforms.lookup(camera, self._world, colours.stamp_ns)
            gap_s = self._transforms.gap(camera, self._world, colours.stamp_ns)
            self._transforms.forget(colours.stamp_ns)
        if pose is not None and gap_s <= STALE_S:
            if gap_s:
                doubts.append(f"tf ends {gap_s:.2f} s away from the picture: the nearest pose is used")
            return pose
        if self._stream is None:
            raise InputError(f"no tf joins the camera's frame {camera!r} to {self._world!r} within {STALE_S} s")
        doubts.append(f"no tf within {STALE_S} s: the camera's motion is estimated")
        return None

    def _begin(self, rig: Rig) -> Stream:
        """A new stream, with the queries of the settings."""
        settings, asked = self._settings, self._settings.queries()
        online = settings.online_s or False
        found = None if online or (settings.discover and not asked) else ()
        budget = {"alpha": settings.alpha, "alpha_frames": settings.alpha_frames or None}
        stream = self._tracker.stream(rig.camera, found, online=online, **budget)
        for query in asked:
            try:
                stream.add(query)
            except QuestError as error:
                self._say("ERROR", f"{query!r} is not followed: {error}")
        self._stream = stream
        self._streams += 1
        self._say("INFO", f"stream {self._streams - 1} begins: {rig.camera!r}")
        return stream

    def _end(self, why: str) -> None:
        """End the stream; the next picture begins another one."""
        self._say("WARN", f"{why}: a new stream begins with the queries of the parameters")
        self._stream = self._rig = self._state = None

    def _tell(self, state: StreamState) -> None:
        """Say which alarms are new."""
        before, self._state = self._state, state
        known = {} if before is None else dict(zip(before.query, before.alarm, strict=True))
        for name, number, alarm in zip(state.names, state.query, state.alarm, strict=True):
            if alarm is not None and known.get(number) is None:
                self._say("WARN", f"alarm of {name}: {alarm.reason}")

    def _refuse(self, problem: str, details: str = "") -> None:
        self._refused += 1
        if problem != self._problem:
            self._say("ERROR", "\n".join(filter(None, (problem, details))))
        self._problem = problem

    def _doubt(self, doubts: tuple[str, ...]) -> None:
        known = {before.partition(":")[0] for before in self._doubts}
        for doubt in doubts:
            if doubt.partition(":")[0] not in known:
                self._say("WARN", doubt)
        self._doubts = doubts

    def _say(self, level: str, text: str) -> None:
        self._notices.append(Notice(level, text))

    def notices(self) -> list[Notice]:
        """What is to be logged since the last call."""
        with self._tracking:
            notices, self._notices = self._notices, []
            return notices

    def diagnostics(self, now_ns: int, *, news: bool = False) -> Any | None:
        """The diagnostics as diagnostic_msgs/DiagnosticArray; with ``news`` None while no level changes."""
        with self._tracking:
            statuses = [self._input(now_ns), *self._health()]
            told = [(status.name, status.level) for status in statuses]
            if news and told == self._told:
                return None
            self._told = told
            return diagnostics_of(self._types, statuses, stamp_ns=now_ns, node=self._name, hardware=self._frame_id)

    def _input(self, now_ns: int) -> Status:
        """What comes."""
        inbox = self._inbox
        level, message = "OK", f"{self._tracked} pictures tracked"
        silent_s = None if self._came_ns is None else (now_ns - self._came_ns) * 1e-9
        if self._problem:
            level, message = "ERROR", self._problem
        elif silent_s is None:
            level, message = "WARN", f"no pictures on {self._topic} yet"
        elif silent_s > SILENT_S:
            level, message = "WARN", f"no pictures on {self._topic} for {silent_s:.0f} s"
        elif self._doubts:
            level, message = "WARN", "; ".join(self._doubts)
        counts = {
            "pictures": inbox.came, "tracked": self._tracked, "dropped while busy": inbox.dropped, "late": inbox.late,
            "without depth in time": inbox.unmatched, "refused": self._refused, "streams": self._streams,
        }  # fmt: skip
        return Status("input", level, message, tuple((key, str(value)) for key, value in counts.items()))

    def _health(self) -> list[Status]:
        """How tracking goes, and each query."""
        stream, state = self._stream, self._state
        if stream is None or state is None:
            return [Status("tracker", "WARN", "no stream yet")]
        unfound = [query.name or query.label or query.kind for query in stream.unbound]
        sought = [f"not found: {', '.join(unfound)}"] if unfound and not stream.looking else []
        watched = "no monitor" if stream.budget is None else str(stream.budget)
        doing = [f"{sum(each is value for each in state.state)} {value}" for value in State]
        troubles = [*state.flags, *sought]
        message = "; ".join(troubles) or ", ".join(doing)
        tracker = Status("tracker", "WARN" if troubles else "OK", message, (("monitor", watched),))
        return [tracker, *statuses_of(state)]

    @_service
    def add(self, stream: Stream, request: Any, response: Any) -> str:
        """Answer quest_msgs/AddQuery."""
        response.query = stream.add(_query(request, stream.frame))
        return f"query {response.query} is followed from the next picture on"

    @_service
    def retire(self, stream: Stream, request: Any, response: Any) -> str:
        """Answer quest_msgs/RetireQuery."""
        stream.retire(_which(request))
        return "retired"

    @_service
    def rename(self, stream: Stream, request: Any, response: Any) -> str:
        """Answer quest_msgs/RenameQuery."""
        if not request.new_name:
            raise InputError("new_name: expected a name, got none")
        stream.rename(_which(request), request.new_name)
        return "renamed"

    @_service
    def answer_alarm(self, stream: Stream, request: Any, response: Any) -> str:
        """Answer quest_msgs/AnswerAlarm."""
        if request.answer == request.RIGHT:
            stream.confirm(_which(request))
        elif request.answer == request.PLACE:
            stream.place(_which(request), request.x_px + 0.5, request.y_px + 0.5)
        else:
            raise InputError(f"answer: expected RIGHT (1) or PLACE (2), got {request.answer}")
        return "taken"

    @_service
    def reset(self, stream: Stream, request: Any, response: Any) -> str:
        """Answer std_srvs/Trigger: the next picture begins a new stream."""
        self._end("on request")
        return "the next picture begins a new stream"


def _query(request: Any, frame: int) -> Query:
    """The query of a request.

    Raises:
        InputError: its kind is unknown, or a field is not as that kind needs it.
    """
    if request.kind == request.POINT:
        return point_query(frame, request.x_px, request.y_px, name=request.name, label=request.label)
    if request.kind == request.LABEL:
        return label_query(f"{request.label}:{request.intent}".removesuffix(":"), request.name)
    if request.kind == request.TEXT:
        return Query.text(request.text, request.name)
    raise InputError(f"kind: expected POINT (1), LABEL (2) or TEXT (3), got {request.kind}")


def _which(request: Any) -> int | str:
    """The query that a request means, by number or name."""
    return request.query if request.query >= 0 else request.name
