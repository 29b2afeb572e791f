"""Batches of motions: integration in lockstep, rollouts."""
