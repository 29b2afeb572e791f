"""What a user writes: coordinates, parameters, bodies, loads, constraints, contacts. No algorithms.

A new kind of body, load or constraint starts here. Open `scene.py` first. `contact` has contacts and grounds;
`user_methods.py` calls and checks the methods of a scene; `identity.py` decides when two scenes share
results.
"""
