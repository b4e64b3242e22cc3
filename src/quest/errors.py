"""The one error family of QueST.

Every error that a user can cause derives from :class:`QuestError`, so that a caller needs a single
``except``. The message names the thing, what was expected, what came, and what to do about it.
"""


class QuestError(Exception):
    """Base of all errors that QueST raises on purpose."""


class InputError(QuestError, ValueError):
    """Frames, depth, cameras or queries that cannot be used as given."""


class RecordingError(InputError):
    """A recording on disk that is missing, empty, inconsistent or in the wrong units."""


class TakeError(QuestError):
    """A take of the store that is missing, torn, or of another format version."""


class ObjectError(QuestError):
    """An object folder or URDF that is missing, damaged, or has nothing to follow."""


class RendererError(QuestError):
    """No device can render, or the renderer broke."""


class WeightsError(QuestError):
    """Weights that are missing, damaged, or of another shape than the network."""


class ConfigError(QuestError, ValueError):
    """A setting outside its range, or settings that contradict each other."""


class MissingExtraError(QuestError, ImportError):
    """An optional part is needed but not installed; the message names the extra to install."""
