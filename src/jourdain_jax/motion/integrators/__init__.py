"""Explicit and implicit integration methods, and events."""
