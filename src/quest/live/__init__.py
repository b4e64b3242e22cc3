"""Local pages: a stream that is watched and corrected live, and queries that are picked on a recording.

A :class:`~quest.live.session.Session` steps a stream and takes edits in between; :mod:`quest.live.server` shows it on a
page of this machine alone; :mod:`quest.live.picking` is the same page on a recording.
"""
