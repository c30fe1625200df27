"""Reduce the samples of a file to one loading and unloading, with time zero at contact.

`condition` runs the steps in order. Each step returns a new `Record` with notes on its changes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from foamfit.arrays import Array, means
from foamfit.data import blocks, contact, cycles, outliers as repair, zeros
from foamfit.data.calibration import with_gravity
from foamfit.data.measurement import (
    FROM_VELOCITY,
    MEASURED,
    MIN_ROWS,
    Dropped,
    Measurement,
    Noise,
    Outliers,
    Record,
    RowCount,
    Specimen,
    Striker,
    Window,
    interior_channel,
)
from foamfit.data.noise import (
    averaged,
    estimated_noise,
    integrated_twice,
    lowest_mean,
    noise_before_contact,
    noise_level,
    noise_of_integral,
)
from foamfit.errors import InputError
from foamfit.text import engineering, percent

# Usual range of each quantity in SI; outside it, a unit is probably wrong.
_USUAL = {
    "height": (1e-5, 1.0, "m"),
    "area": (1e-10, 1.0, "m²"),
    "peak strain": (1e-4, 1.0, ""),
    "peak stress": (10.0, 1e9, "Pa"),
    "modulus (peak stress over peak strain)": (10.0, 1e11, "Pa"),
    "duration": (1e-6, 1e7, "s"),
}
_AT_START = 0.05  # share of the peak that a stress may have at the start
_ROUNDING = 1e-12  # share of its values by which a constant channel may vary
_WHOLE, _UNKNOWN = Window(), Noise()  # the whole file; no noise is stated


def condition(
    record: Record, specimen: Specimen, *, striker: Striker | None = None,
    window: Window = _WHOLE, spread: float = 0.0, stated: Noise = _UNKNOWN, late: bool = False,
) -> Measurement:  # fmt: skip
    """Reduce all samples of a file to one loading and unloading; the test has no name yet.

    A record with a striker and a time is an impact, any other a slow test. Channels are positive
    in compression. `spread` is the standard deviation of the striker's velocity, m/s. The result
    has at most 1500 samples, and time and displacement are zero at the start of contact. The noise
    is estimated from samples before contact or from those of a held channel, or that of the samples
    is `stated`. A motion that may be `late` does not show the contact.
    """
    given, impact = striker or Striker(), striker is not None and record.time is not None
    if impact and window.cycle not in (None, 1):
        raise InputError("[window] cycle is for slow tests; for an impact give start and end.")
    record = repair.cut_strays(cut_to_window(record, window))
    record = repair.mark_clipped(repair.bridge_outliers(record))
    _check_varying(record)
    still = [] if impact else repair.find_standstills(record)
    record, held = repair.fill_staircase(record)
    record = repair.bridge_standstills(record, still, specimen.height)
    excess = record.excess
    found = [] if impact else cycles.find_cycles(record)
    chosen = cycles.choose_cycles(found, window.cycle, window.last)
    used = chosen or cycles.Cycle(number=1, place=0, first=0, top=0, end=len(record), turn=0)
    # Contact starts in the first cycle.
    first = cycles.cut_to_cycle(record, found, found[0]) if found else record
    curves = first.curves("acceleration")
    levels = {c: estimated_noise(v) for c, v in curves.items()} | held
    flight = None
    if impact:
        record, start, span = _contact_of_impact(record, levels, given, late=late)
        first = record
        given, flight, notes = zeros.flight_of(record, start, span, levels, given, spread)
        record = record.noted(*notes)
    else:
        start = contact.start_of_slow_test(first, levels)
        end = len(first) if used.place else used.end - used.first
        span = zeros.Span(start.first, end, start.resting, end)
    record = zeros.take_zeros(record, first, start, span, levels, impact=impact)
    if used.place:  # a later cycle has its own contact
        record = cycles.cut_to_reload(record, found, used, specimen.height)
        rise = first_rise(record, contact.Start("", 0.0, 0), levels)
    else:
        rise = first_rise(record.rows(slice(len(first))), start, levels)
        record = cycles.zero_between(record, found, used)
        record = cycles.cut_to_cycle(record, found, chosen) if chosen else record
        record = cut_to_contact(record, start, span)
    if impact:
        record = zeros.mark_flight(record, start, span, levels)
        record = start_within_height(integrate_motion(record, specimen, given), specimen, given)
    else:
        record = replace(integrate_motion(record, specimen, given), acceleration=None)
    whole = checks(record, specimen, several=used.last is not None)
    whole, block = blocks.without_holds(whole, impact=impact)
    record = blocks.thin(whole, block)
    noise = noise_before_contact(curves, start.resting, record.curves("acceleration"), block)
    noise |= {c: blocks.noise_of_blocks(lv, block, whole.sampled.get(c)) for c, lv in held.items()}
    # Else the integral shows its own noise.
    if whole.motion == FROM_VELOCITY and (impact or "stress" in whole.derived):
        velocity = whole.curves("velocity")["velocity"]
        noise["displacement"] = noise_of_integral(whole.instants, velocity)
    # The rows of a record without time are counted from the first one kept.
    zero = 0.0 if used.place else whole.origins.get("contact_time", float(span.first))
    test = _measured(
        whole, record, block, excess, specimen=specimen, striker=striker and given, flight=flight,
        noise=replace(_stated_of_blocks(stated, levels, whole, block), estimated=noise),
        contact="stress" if used.place else start.by, cycle=used.number, last_cycle=used.last,
        cycles=tuple(cycle.number for cycle in found) or (1,),
        rise=rise and _on_clock(rise, whole, block, zero),
    )  # fmt: skip
    return with_gravity(test) if impact else test


def _on_clock(rise: contact.Kink, record: Record, block: int, zero: float) -> contact.Kink:
    """Return a rise on the clock of the samples, which begins at `zero`.

    Without time it counts samples, each of which is `block` rows.
    """
    size = block if record.time is None else 1
    return (rise[0] - zero - 0.5 * (size - 1)) / size, rise[1] / size


def _stated_of_blocks(stated: Noise, levels: contact.Levels, record: Record, block: int) -> Noise:
    """Return the stated noise of samples for means of blocks; `levels` give its correlation."""
    slow = {c: replace(one, time=levels.get(c, one).time) for c, one in stated.levels.items()}
    taken = record.sampled
    sigmas = {c: blocks.noise_of_blocks(slow[c], block, taken.get(c)).sigma for c in slow}
    return Noise(sigmas.get("stress"), sigmas.get("displacement"))


def _contact_of_impact(
    record: Record, levels: contact.Levels, striker: Striker, *, late: bool
) -> tuple[Record, contact.Start, zeros.Span]:
    """Return the record of an impact without drift, its start of contact, and its rows to keep."""
    record = contact.first_contact(record)
    start = contact.start_of_impact(record, levels, late=late)
    straight = zeros.without_drift(record, start, levels)
    if straight is not record:
        record, start = straight, contact.start_of_impact(straight, levels, late=late)
    if record.stress[start.first :].max() == 0.0:
        raise _never_positive(record.stress)
    gauge = zeros.gauge_before(record, start, levels, striker)
    if gauge != "flight":  # the motion did not come into the range of the gauge
        start = replace(start, seen=0)
        gauge = zeros.gauge_before(record, start, levels, striker)
    start = replace(start, gauge=gauge)
    return record, start, zeros.span_of_impact(record, start, levels)


def _measured(
    whole: Record, thinned: Record, block: int, excess: dict[str, Array], **known: Any
) -> Measurement:
    """Return the test in a record, averaged in blocks, with what else is known of it."""
    outliers = repair.outliers_of_blocks(whole, block)
    instants = whole.instants if whole.time is not None else whole.instants // block
    stood = [instants[rows] for rows in whole.standstills.values() if rows.any()]
    spikes = {name: int(np.count_nonzero(values)) for name, values in excess.items()}
    origins = dict(whole.origins)
    return Measurement(
        name="", path=None, data_sha256="",  # these follow later
        time=thinned.time, stress=thinned.stress, displacement=thinned.displacement,
        acceleration=thinned.acceleration, interior=thinned.interior, sampled=thinned.sampled,
        notes=(*thinned.notes, *repair.notes_on(whole, spikes, outliers)),
        outliers=outliers, count=count_rows(whole, outliers, block), block=block,
        start_strain=origins.pop("start_strain", 0.0), origins=origins, zeros=whole.zeros,
        motion=whole.motion, before=whole.before, derived=whole.derived, braked=whole.braked,
        standstills=tuple((float(at[0]), float(at[-1])) for at in stood),
        **known,
    )  # fmt: skip


def first_rise(record: Record, start: contact.Start, levels: contact.Levels) -> contact.Kink | None:
    """Return the contact by the first rise of the stress, or of a gauge at rest, less its zero."""
    moved = start.by == "motion" and start.gauge == "rest"
    name = "displacement" if moved else "stress"
    values, zero = record.channel(name), record.zeros.get(name)
    if values is None or name in record.derived:
        return None
    return contact.rise_of(record.instants, values, levels[name], start.resting, zero)


def cut_to_contact(record: Record, start: contact.Start, span: zeros.Span) -> Record:
    """Keep the rows in contact and a few around; shift time to zero at contact."""
    n, lead = len(record), start.first - span.first
    cut = f"; {span.first} samples before and {n - span.end} after are cut, "
    cut += f"{span.end - span.first} kept" + (f", {lead} of them before contact" if lead else "")
    at = "" if record.time is None else f", {engineering(start.time, 's')} in the file"
    cut = cut if span.end - start.first < n else ""
    record = record.noted(f"Contact starts {start.how}{at}{cut}.")
    if not span.returned:
        record = record.noted(
            "Check: the record ends before the stress has returned to zero, or its zero drifts."
        )
    if record.time is not None:
        record = record.shifted("time", start.time)
    return record.between(span.first, span.end, "before contact starts", "after contact ends")


def cut_to_window(record: Record, window: Window) -> Record:
    """Keep the samples between the start and end of the window, on the clock of the file."""
    if (window.start, window.end) == (-np.inf, np.inf):
        return record
    if record.time is None:
        raise InputError("[window] start and end need a time column; the file has none.")
    inside = (record.time >= window.start) & (record.time <= window.end)
    kept = int(inside.sum())
    if kept < MIN_ROWS:
        first, last = (engineering(float(t), "s") for t in record.time[[0, -1]])
        needed = f"at least {MIN_ROWS} between {first} and {last} are needed"
        raise InputError(f"[window] start and end leave {kept} samples; {needed}.")
    note = f"[window] cut {len(record) - kept} of {len(record)} samples."
    record = record.without(~inside, "outside [window] start and end").noted(note)
    for name, values in record.curves().items():
        if np.ptp(values) == 0:
            raise InputError(f"the {name} is constant within [window]; it must vary.")
    return record


def _check_varying(record: Record) -> None:
    """Raise InputError for a channel that varies only at its ends, in spikes or by rounding."""
    for name, values in record.curves().items():
        inner = values[1:-1]
        if np.ptp(inner) <= _ROUNDING * np.abs(inner).max():
            raise InputError(f"the {name} is constant but for single rows; it must vary.")


def integrate_motion(record: Record, specimen: Specimen, striker: Striker) -> Record:
    """Integrate a missing displacement: w(0) = 0, w'(0) = v, and w'' = g − a or g − σA/m.

    Channels are assumed to be linear between samples.
    """
    if record.displacement is not None:
        return replace(record, acceleration=None)
    time = record.time
    assert time is not None  # a file without a time was rejected
    if record.clipped is not None and record.acceleration is None and record.velocity is None:
        wrong = "the force is clipped, so the motion cannot be integrated from it"
        raise InputError(f"{wrong}; give a displacement, an acceleration or a velocity.")
    if record.acceleration is not None and striker.velocity:
        rate, source = -record.acceleration, "acceleration"
    elif record.velocity is not None:
        rate, source = record.velocity, "velocity"
    else:
        assert striker.mass  # a file without it was rejected
        rate, source = -record.stress * specimen.area / striker.mass, "force"
    gravity = striker.gravity or 0.0
    # Insert time zero, which may lie between two samples or before the first.
    at = int(np.searchsorted(time, 0.0))
    if source == "velocity":
        start = float(np.interp(0.0, time, rate))
    else:
        start, rate = gravity, gravity + np.where(time < 0.0, 0.0, rate)
    t, r = np.insert(time, at, 0.0), np.insert(rate, at, start)
    w, twice = integrated_twice(t, r)
    if source != "velocity":
        assert striker.velocity
        w = (striker.velocity - w[at]) * (t - t[0]) + twice
        record = replace(record, derived=(*record.derived, "displacement"))
    w = np.delete(w - w[at], at)
    return replace(record, displacement=w, motion=f"integrated from {source}")


def stress_of_motion(
    time: Array, displacement: Array | None, velocity: Array | None, ratio: float, gravity: float
) -> Array:
    """Return the stress that decelerates a striker: `ratio` (mass over area, kg/m²) times g − w''.

    The second derivative w'' is that of a smoothing spline whose residuals equal the noise.
    Intervals in which the gauge is at rest before and after contact are excluded.
    """
    from scipy.interpolate import make_smoothing_spline

    values = displacement if velocity is None else velocity
    assert values is not None  # see `Source.needed`
    noise, first, end = estimated_noise(values), 0, len(time)
    if velocity is None:
        top = int(np.argmax(values))
        rise, fall = (time[: top + 1], values[: top + 1]), (-time[top:][::-1], values[top:][::-1])
        if found := contact.leave_rest(*rise, noise, contact.STILL_MOTION):
            first = int(np.searchsorted(time, found[0]))
        if found := contact.leave_rest(*fall, noise, contact.STILL_MOTION):
            end = int(np.searchsorted(time, -found[0]))
    n = end - first
    block = max(1, min(round(noise.time), n // 50), n // 1000)
    edges = np.arange(first, end, block)
    t, y = (means(x[:end], edges) for x in (time, values))
    t, step = t - t[0], (t[-1] - t[0]) / len(t)
    # With a slightly underestimated noise, the curve would follow the noise.
    sigma, low, high = 1.1 * averaged(noise, block).sigma, -6.0, 14.0
    for _ in range(24):
        middle = 0.5 * (low + high)
        curve = make_smoothing_spline(t / step, y, lam=10.0**middle)
        close = float(np.std(curve(t / step) - y)) <= sigma
        low, high = (middle, high) if close else (low, middle)
    order = 2 if velocity is None else 1
    braked = ratio * (gravity - curve.derivative(order)(t / step) / step**order)
    stress = np.zeros(len(time))
    stress[first:end] = np.interp(time[first:end] - time[first], t, braked)
    return stress


def start_within_height(record: Record, specimen: Specimen, striker: Striker) -> Record:
    """Delay the contact of an impact if the displacement would otherwise exceed the height."""
    w, most = record.curves()["displacement"], 0.97 * specimen.height
    over, limit = float(w.max()) - most, 0.5 if "stress" in record.derived else 0.2
    if not striker.velocity or not 0.03 * specimen.height <= over < limit * specimen.height:
        return record
    late = over / striker.velocity
    record = record.shifted("time", late)
    if record.motion == MEASURED:
        record = record.shifted("displacement", over)
    else:  # an integrated motion has no zero in the file
        record = record.changed("displacement", w - over)
    done = f"Contact is assumed {engineering(late, 's')} later"
    return record.noted(f"{done}, so that the displacement does not exceed the height.")


def checks(record: Record, specimen: Specimen, *, several: bool) -> Record:
    """Reject strains beyond one, note implausible data (no reversals of `several` cycles)."""
    displacement, height = record.curves()["displacement"], specimen.height
    notes, motion = list[str](), record.motion
    if motion != MEASURED:
        notes.append(f"The file has no displacement: the motion is {motion}.")
    notes += [] if several else cycles.inner_reversals(displacement)
    if len(record) < MIN_ROWS:
        raise InputError(f"only {len(record)} samples are in contact; at least {MIN_ROWS} needed.")
    strain = float(displacement.max()) / height
    if strain >= 1:
        cause = "the unit of displacement or strain" if motion == MEASURED else "the striker"
        raise InputError(f"strain reaches {strain:.3g}, beyond one; check height and {cause}.")
    peak = float(record.stress.max())
    if peak <= 0.0:
        raise _never_positive(record.stress)
    for name, values in record.curves().items():
        measured = values[record.sampled.get(name, slice(None))]
        if not measured.size or np.ptp(measured) == 0:
            wrong = f"the {name} does not vary in the part that is used"
            raise InputError(f"{wrong}; correct its column, or choose another part by [window].")
    duration = 1.0 if record.time is None else float(np.ptp(record.time))
    sizes = height, specimen.area, strain, peak, peak / strain if strain > 0 else 1e3, duration
    for value, (name, (low, high, unit)) in zip(sizes, _USUAL.items(), strict=True):
        if not low <= value <= high:
            shown, least, most = (f"{v:.4g} {unit}".strip() for v in (value, low, high))
            said = f"the {name} is {shown}, but {least} to {most} is usual in tests"
            notes.append(f"Check: {said}; check the units (mm or Mm, mN or MN).")
    for node, values in record.interior.items():
        name, largest = interior_channel(node), float(values.max())
        if largest >= height:
            reached = f"{engineering(largest, 'm')}, the height {engineering(height, 'm')}"
            raise InputError(f"{name} reaches {reached}; check its unit.")
        if largest > 1.05 * displacement.max():
            notes.append(f"Check: {name} goes farther than the top; check its unit and its node.")
    stress = record.stress  # a fast ramp may load the second row
    noise, first = 3.0 * noise_level(stress), float(stress[:3].mean())
    if (load := min(first, float(stress[0]) + noise)) > _AT_START * peak:
        notes.append(f"Check: {zeros.UNDER_LOAD}, at {percent(load / peak)} of the peak stress.")
    if first + noise < -_AT_START * peak:
        wrong = f"the stress starts below zero, at {engineering(first, 'Pa')}"
        notes.append(f"Check: {wrong}; unless it is tension, correct the zero of the force.")
    lowest, width = lowest_mean(stress, int(np.argmax(stress)))
    if lowest < -max(0.002 * peak, 4 * noise_level(stress) / np.sqrt(width)):
        after = f"{engineering(lowest, 'Pa')} after the peak (adhesion, drift or vibration)"
        notes.append(f"The stress goes down to {after}; it is kept.")
    density = (specimen.mass or 0.0) / (specimen.area * height)
    if specimen.mass and not 1 < density < 3000:
        notes.append(f"Check: mass and volume give a density of {density:.3g} kg/m³.")
    return record.noted(*notes)


def _never_positive(stress: Array) -> InputError:
    least, most = (engineering(float(v) + 0.0, "Pa") for v in (stress.min(), stress.max()))
    wrong = f"the stress is never positive in the part that is used, only {least} to {most}"
    remedy = "correct its zero in the file, or choose another part or cycle by [window]"
    return InputError(f"{wrong}; {remedy}.")


def count_rows(record: Record, outliers: dict[str, Outliers], block: int) -> RowCount:
    """Count the rows of the file that are used, and those dropped with the reasons."""
    dropped, used = list(record.dropped), np.ones(len(record), dtype=bool)
    of_blocks = {c: np.repeat(o.left_out, block)[: len(record)] for c, o in outliers.items()}
    line, excess = "bridged by a straight line", record.excess
    reasons = {f"a spike or gap of the {c}, {line}": spikes != 0.0 for c, spikes in excess.items()}
    reasons[f"the displacement stands still, {line}"] = record.stood_still
    if record.clipped is not None:
        reasons["the force is clipped"] = of_blocks["stress"] & record.clipped
    for name, left_out in of_blocks.items():
        reasons[f"in a block of {block} samples of the {name} that is not fitted"] = left_out
    for why, rows in reasons.items():
        lost = record.row_numbers[rows & used]
        used[rows] = False
        dropped += [Dropped.of(lost, why)] if lost.size else []
    total = len(record) + sum(item.rows for item in record.dropped)
    in_order = tuple(sorted(dropped, key=lambda item: item.first))
    return RowCount(total, int(used.sum()), in_order)
