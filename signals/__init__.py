"""What arrives at the antenna port and leaves the front end: codes, messages, orbits, motion, IF samples.

Data contract. IF samples travel as *slabs*: ``(n0, iq)`` with ``n0`` the absolute index of the first sample and
``iq`` a C-contiguous planar array of shape (2, n), row 0 = I, row 1 = Q, dtype int8, int16 or float32 (real IF:
row 1 is zero). Records are in ``signals.records``, constants in ``signals.constants``. This file imports nothing,
so that finding the data costs no start-up time.
"""
