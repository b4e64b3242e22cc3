"""TAP-Vid and TAPVid-3D: their metrics, videos in their layouts, and trackers asked as they ask."""
