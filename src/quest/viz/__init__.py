"""Pictures a person can judge: overlay videos and contact sheets."""
