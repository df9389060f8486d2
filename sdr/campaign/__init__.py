"""Campaigns: a grid of settings times many trials, counted into P_MD, P_FA and tracking error.

In the order in which a campaign goes through them: ``spec`` is the file and its grid, ``recorded`` the same over
recordings, ``load`` reads either; ``trials`` is one trial, ``tally`` counts them and says when a point stops; ``run`` hands
trials to the workers of ``crew`` and ``results`` keeps what comes back, through a kill if need be. ``figures`` draws it,
and ``confirm`` runs one point again on IF samples.
"""
