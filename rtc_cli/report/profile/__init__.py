"""The page of a profile: where a chunk's time goes, and what follows for the robot."""
