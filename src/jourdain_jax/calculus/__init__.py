"""Mathematics without physics: rotations, matrices, roots, derivatives, scalar operations, files."""
