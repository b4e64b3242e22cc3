"""Pictures a person can judge: overlay videos, contact sheets, and a live view in the terminal."""
