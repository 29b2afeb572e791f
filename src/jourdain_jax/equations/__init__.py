"""Jourdain's principle of virtual power: kinematics, virtual power, constraints, reduction, accelerations.

    kinematics.py -> virtual_power.py -> rows.py -> reductions.py -> gibbs_appell.py, lagrange.py, minimal.py

Every formula of docs/theory.md stands beside its code here or in `dynamics`. Contacts that switch:
`contact_laws.py`, `phases.py`, `impacts.py`. Open `kinematics.py` first.
"""
