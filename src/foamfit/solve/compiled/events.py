"""Steps in time, and the events within them: changes of branch and the end of contact.

Events are found on the dense output of a step.
"""

from __future__ import annotations

from foamfit.solve.compiled.motion import JUMP, look
from foamfit.solve.compiled.run import call_inside, entering, numbers, spring
from foamfit.springs.compiled import contract
from foamfit.springs.compiled.contract import OF_HELD, OF_PARAMETER, OF_STRESS, inner, past
from foamfit.springs.laws.record import OWN_ETA

ROUNDED = 1e-12  # strain past an end that rounding explains, of a spring that moves away from it
RISEN = 1e-9  # base stress over the largest stress above which its return to zero ends the contact
MIDDLE = 0.6  # share of a step at which s.midway is the strain rate; 0.58 of an implicit step
DIP = 0.3  # least strain rate within a step, over its variation, below which the rate may vanish
AT_ONCE = 1e-9  # share of a step within which an event is at its start
DIPS = 16  # pieces of a step in which it is searched for such a rate
# Kinds of events: a branch ends at its upper or lower strain, a spring turns, contact ends. Then a
# greatest and a least strain.
TOP_END, LOW_END, TURN, RELEASE, TOP_TURN, LOW_TURN = range(6)
PLAIN, SAMPLED, DOUBTFUL, FAILED = range(4)  # ends of an attempted step


@entering
def enter_branch(c, i, up, y):
    """Leave the branch at its upper or lower end; derivatives of held numbers change as well."""
    s, n, p = spring(c, i), numbers(c, i), c.p
    slope = s.slope
    changes = past(s.by, n.parameters)  # no derivatives of a BY_STRESS law
    if n.internal:
        call_inside(c, JUMP, i, up, y, y, y, y)
        return
    contract.call_switch(n.switch, past(s, c.row), s, up, changes)
    if not n.by_stress:
        return
    if not c.solved and n.x_at >= 0:
        y[n.x_at] = s.x
    held, change = past(c.held, 2 * i * p), OF_PARAMETER + n.parameters
    for j in range(p):
        d_sigma = slope * c.strain[i * p + j] + c.part[i * p + j]
        first, second, own = held[j], held[p + j], c.owned[i * p + j]
        for h in range(2):
            by = past(changes, h * change)
            value = by[OF_STRESS] * d_sigma + by[OF_HELD] * first + by[OF_HELD + 1] * second
            if 0 <= own < OWN_ETA:
                value += by[OF_PARAMETER + own]
            held[h * p + j] = value


# ---------------------------------------------------------------- along a step


@inner
def _excess(c, i, kind):
    """Return how far a spring is past the end of its branch, or the contact past its own."""
    s = spring(c, i)
    if kind == RELEASE:
        return -c.carried[0]
    if kind >= TURN:
        return -s.rate * (s.turns if kind == TURN else 1.0 if kind == TOP_TURN else -1.0)
    return s.eps - s.high if kind == TOP_END else s.low - s.eps


@inner
def _root(c, low, high, i, kind):
    """Return where an excess becomes positive between two shares, by Illinois' method."""
    look(c, high)  # where the values mostly belong to
    s, f_high, side, dt, middle = spring(c, i), _excess(c, i, kind), 0, c.now.step, high
    value, rate = f_high, s.rate
    look(c, low)
    f_low = _excess(c, i, kind)
    if f_low >= 0.0:
        return low
    for _ in range(60):
        if kind < TURN:  # Newton's method
            middle -= value / ((rate if kind == TOP_END else -rate) * dt)
        if kind >= TURN or not low < middle < high:
            middle = high - f_high * (high - low) / (f_high - f_low)
        if high - low <= 4e-16 or not low < middle < high:
            break
        look(c, middle)
        value, rate = _excess(c, i, kind), s.rate
        if kind < TURN and abs(value) < 1e-15:
            return middle
        if value >= 0.0:
            f_low *= 0.5 if side == 1 else 1.0
            high, f_high, side = middle, value, 1
        else:
            f_high *= 0.5 if side == -1 else 1.0
            low, f_low, side = middle, value, -1
    return low if middle <= low else high


@inner
def _locate(c, low, high, i, kind):
    """Return where an excess becomes positive between two shares."""
    there = _root(c, low, high, i, kind)
    if kind >= TURN or there - low > AT_ONCE * (high - low):
        return there
    # A spring past an end by rounding may move away: the event is where it returns.
    part = AT_ONCE * (high - low)
    while part < 0.5 * (high - low):
        part *= 4.0
        look(c, low + part)
        value = _excess(c, i, kind)
        if value < -ROUNDED:
            return _root(c, low + part, high, i, kind)
        if value > ROUNDED:
            break
    return there


@inner
def _earliest(c, before, share):
    """Return the first of the events in (before, share] whose effect is seen at the end."""
    found, who, what = share, -1 + c.none, -1 + c.none
    look(c, found)
    if c.now.pressed > 0.0 and c.carried[0] <= 0.0:
        who, what = c.none, RELEASE + c.none
        found = _locate(c, before, found, who, what)
        look(c, found)
    for i in range(c.count):
        for kind in range(RELEASE):
            over, falls = _excess(c, i, kind), spring(c, i).rate < 0.0
            # Past an end by rounding, it moves away.
            leaves = kind < TURN and over < ROUNDED and falls == (kind == TOP_END)
            if found > before and over > 0.0 and not leaves:
                there = _locate(c, before, found, i, kind)
                if who < 0 or there < found:
                    found, who, what = there, i, kind
                look(c, found)
    if who >= 0 and what != RELEASE and c.now.pressed > 0.0:  # the contact ends as well
        look(c, min(found + 1e-9, 1.0))
        what = RELEASE + c.none if c.carried[0] <= 0.0 else what
    return found, who, what


@inner
def first_event(c):
    """Return where in a step its first event is, of which spring (-1: none) and of which kind."""
    # A spring may pass an end and return, or turn twice, so that extrema are judged as well.
    nobody, before, pieces = -1 + c.none, 0.0, 1
    look(c, 1.0)
    for i in range(c.count):
        s = spring(c, i)
        if s.old_rate * s.rate <= 0.0:
            pieces = max(pieces, 4)
        if _may_dip(s):
            pieces = DIPS
    for piece in range(1, pieces + 1):
        share = piece / pieces
        found, who, what = _earliest(c, before, share)
        if who >= 0:
            return found, who, what
        for i in range(c.count):
            s = spring(c, i)
            look(c, share)
            if _may_pass(s, (share - before) * c.now.step):
                turn = _locate(c, before, share, i, TOP_TURN if s.rate < 0.0 else LOW_TURN)
                found, who, what = _earliest(c, before, turn)
                if who >= 0:
                    return found, who, what
        look(c, share)
        for i in range(c.count):
            s = spring(c, i)
            s.old_eps, s.old_rate = s.eps, s.rate
        before = share
    return 1.0, nobody, nobody


@inner
def _may_pass(s, dt):
    """Whether an extremum since the old strain may lie past an end of the branch."""
    if not s.old_rate * s.rate < 0.0:
        return False
    most = 0.5 * dt * max(abs(s.old_rate), abs(s.rate))  # it is at most this far away
    return max(s.eps, s.old_eps) + most > s.high or min(s.eps, s.old_eps) - most < s.low


@inner
def _may_dip(s):
    """Whether a spring may move against its branch within a step, though not at its ends."""
    start, middle, end = s.turns * s.old_rate, s.turns * s.midway, s.turns * s.rate
    # The parabola through the rates at both ends and at MIDDLE has its least value there.
    first = (middle - start) / MIDDLE
    bend = (end - middle) / (1.0 - MIDDLE) - first
    if not (start > 0.0 and end > 0.0 and bend > 0.0):
        return False
    x = 0.5 * (MIDDLE - first / bend)
    least = start + (first + bend * (x - MIDDLE)) * x
    return 0.0 < x < 1.0 and least < DIP * (max(start, end) - least)


@inner
def keep_midway(c):
    """Keep the strain rates about the middle of a step."""
    for i in range(c.count):
        s = spring(c, i)
        s.midway = s.rate


@inner
def suspicious(c, dt):
    """Whether a step may contain an event, by the values at both ends."""
    if c.now.pressed > 0.0 and c.carried[0] <= 0.0:
        return True
    for i in range(c.count):
        s = spring(c, i)
        if s.eps > s.high or s.eps < s.low or s.turns * s.rate < 0.0:
            return True
        if _may_pass(s, dt) or (s.turns != 0.0 and _may_dip(s)):
            return True
    return False


@inner
def keep_values(c):
    """Keep strains and rates of the beginning of a step, and the largest stress."""
    largest = c.now.largest
    for i in range(c.count):
        s = spring(c, i)
        s.old_eps, s.old_rate = s.eps, s.rate
        largest = max(largest, abs(s.total))
    for g in range(c.groups):  # with dashpots
        largest = max(largest, abs(c.carried[g]))
    c.now.largest = largest
