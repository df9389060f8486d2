"""Interference monitors on the live receiver: section ``[[receiver.monitor]]``.

``channels`` is that section and watches every locked channel, ``front`` the samples. Each has its ``post``: a monitor that
is trained on the first seconds of one stream, tests what follows and keeps its alarms. ``null`` says where thresholds
come from, ``figures`` draws statistics and alarms.
"""
