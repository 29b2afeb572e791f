"""Studies of many motions: designs, runs that survive interruption, storage, statistics, sensitivity indices."""
