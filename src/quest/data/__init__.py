"""The take store, recordings on disk, and files of tracks."""
