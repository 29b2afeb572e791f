"""What is found once about a scene: states to look at, rank, privileged speeds, what depends on time, the traced graph of scalars."""
