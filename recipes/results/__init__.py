"""The evidence: many systems in the same scenes, one table and two figures.

``evaluate`` writes episodes, summaries and trajectories; ``table`` and ``figures`` read nothing else.
"""
