"""Parts of `work_precision.py`: problems, references, methods, peers, measuring, drawing, tables."""
