"""Hysteresis as a list of interrupted branches: (2.8) and (2.9).

A branch is (start, target, upwards): two points (v, x) and its direction. The last of
the list is active; each of the others was left at the start of the next one, which
returns to the start of the former. When it arrives there, both end.
"""

import math


def on(branch, v, shapes):
    """Return x at v on a branch; shapes are (alpha, tau) rising and falling."""
    (v1, x1), (v2, x2), upwards = branch
    alpha, tau = shapes[0] if upwards else shapes[1]
    whole = (v2 - v1) * (1.0 + alpha * math.exp(-tau * abs(v2 - v1)))
    part = (v - v1) * (1.0 + alpha * math.exp(-tau * abs(v - v1)))
    return x1 + (x2 - x1) * part / whole


def passed(v, point, upwards):
    return v >= point[0] if upwards else v <= point[0]


def follow(path, lower, upper, shapes, depth):
    """Return x along the path from rest at path[0], with `depth` nested branches."""
    rising, falling = (lower, upper, True), (upper, lower, False)
    branches = [rising if path[0] >= lower[0] else falling]
    last = path[0]
    out = []
    for v in path:
        upwards = branches[-1][2] if v == last else v > last
        if upwards != branches[-1][2]:
            turn = (last, on(branches[-1], last, shapes))
            if len(branches) <= depth:
                branches.append((turn, branches[-1][0], upwards))
            elif passed(v, branches[-1][0], upwards):
                branches.pop()
        while upwards == branches[-1][2] and len(branches) > 1:
            if not passed(v, branches[-1][1], upwards):
                break
            del branches[-2:]
            branches = branches or [rising if upwards else falling]
        out.append(on(branches[-1], v, shapes))
        last = v
    return out
