"""Learning while driving: the factor between the pace of a kind of ground (class and slope) and its prior.

A kind of ground is a class and a bin of slopes of five degrees. A vehicle measures y = ln(driven pace / prior pace)
on each cell that it drives for the first time, and its author states, of each kind, the cells and the trimmed mean
and variance of y (`measurements`). The measurements of all authors give one factor per kind of ground, by which the
cost map multiplies the prior (`learned_factors`). Three promises:

- Replicas that hold the same measurements have the same factors, bit for bit: it is all integer arithmetic.
- No author moves a factor by more than its share: five or more are judged by their median, fewer by capped weights.
- A factor lies between 1/4 and 4, and lethal ground stays lethal.
"""
