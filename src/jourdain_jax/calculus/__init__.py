"""Mathematics without physics: rotations, pseudo-inverses, null spaces, guards on the mode of differentiation."""
