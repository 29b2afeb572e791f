"""Families of generated cases that search for motions that are wrong and do not say so; `bench/hunt.py` runs
them.
"""
