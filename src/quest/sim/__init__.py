"""Simulated takes: objects, motion scripts, SAPIEN rendering and ground truth; the only room that imports SAPIEN.

:func:`quest.sim.objects.load_object` reads an object folder, :func:`quest.sim.generate.generate_take` makes a take of
it, :mod:`quest.sim.procedural` makes up objects, :mod:`quest.sim.plan` says which takes a run makes.
"""
