"""Studies of many motions: designs, interruptible runs, storage, statistics, sensitivity indices."""
