"""The command line: one thin file per command, whose frozen dataclass is the command's arguments."""
