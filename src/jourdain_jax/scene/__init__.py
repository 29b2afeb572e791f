"""What a user writes: coordinates, parameters, bodies, loads, constraints, contacts. No algorithms.

A new kind of body, load or constraint starts here. Open `scene.py` first; `contact` holds contacts and
grounds; `user_methods.py` calls and checks the methods of a scene; `identity.py` says when two scenes are
alike.
"""
