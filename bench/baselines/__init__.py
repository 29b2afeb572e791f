"""What the lowered right-hand sides are measured against: hand-derived equations, dense autodiff,
hand-derived ones in a flat array, heyoka.
"""
