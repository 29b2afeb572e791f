"""Contacts: shapes, grounds, the point of contact, friction and restitution.

Open `contacts.py` first. `contact_points.py` finds the nearest point of a ground; `../modes.py`
declares the modes and events of contacts that slip, lift or strike; `../loads.py` has friction in joints,
and blades that may slip.
"""
