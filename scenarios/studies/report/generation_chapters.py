"""Chapters on motion from the twin: generated near its training data, and recovery to a cooler posture."""

import numpy as np

from fleet.motion import RATE_HZ
from fleet.robot import POSTURES
from scenarios.motion.generate import Verification, generate
from scenarios.motion.perform import bare_arm
from scenarios.motion.recover import hold_until, recover
from scenarios.show.page import Section, Table
from scenarios.studies.ranking import CARRIER
from scenarios.studies.report.context import Lab
from scenarios.studies.report.figures import ACCENT, CRITICAL, NORMAL, Line, lines_figure, picture

STRENGTHS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Perturbations, in posterior standard deviations."""
SHOWN = 4
HOLD_KG, WARM_C = 2.5, 50.0
POSTURE = "raised"


def generation_chapter(lab: Lab) -> Section:
    """Generated motions and their distance from the data."""
    study = lab.study
    verification = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    arm, made = bare_arm(study.robot, study.motors, study.thermal), []
    for done, s in enumerate(STRENGTHS):
        lab.progress("generating", done / len(STRENGTHS))
        how = {"count": lab.size.generated, "seed": lab.seeds[0], "verification": verification}
        made.append(generate(lab.twin, arm, study.train.plans, s=s, **how))
    distance = np.array([np.mean([motion.distance_rad for motion in each.motions]) for each in made])
    cool = float(np.mean([motion.peak_c.max() < study.cool_c for each in made for motion in each.motions]))
    accepted, drawn = sum(len(each.motions) for each in made), sum(each.draws for each in made)
    sentences = (
        f"{accepted} of {drawn} generated motions passed verification. All of them were performed in MuJoCo within the "
        f"tracking bound; {cool:.1%} truly stay below {study.cool_c:g} °C over the horizon (target 95 %).",
        f"Their distance from the source (rms over joints and time) is {distance[0]:.3f} rad at s = 0, the loss of "
        f"reconstruction alone, {distance[1]:.3f} rad at s = {STRENGTHS[1]:g} and {distance[-1]:.3f} rad at "
        f"s = {STRENGTHS[-1]:g}.",
    )
    near = made[STRENGTHS.index(1.0)].motions
    # The source that moves most: a hold shows little.
    source = max((m.source for m in near), key=lambda plan: float(np.ptp(plan.cycle.profile[:, 0], axis=0).max()))
    same = [source, *[motion.plan for motion in near if motion.source is source][:SHOWN]]
    panels = {}
    for joint in (0, CARRIER, 3, 5):
        q = [plan.cycle.profile[:, 0, joint] for plan in same]
        time_s = [np.arange(len(each)) / RATE_HZ for each in q]
        new = [Line(t, each, ACCENT, width=1.0) for t, each in zip(time_s[1:], q[1:], strict=True)]
        names = ["generated", *(f"_{i}" for i in range(1, len(new)))]
        panels[f"joint {joint + 1}"] = dict(zip(names, new, strict=False)) | {"original": Line(time_s[0], q[0], NORMAL)}
    motions = lines_figure(
        panels,
        title=f"At s = 1 generated motions lie {distance[STRENGTHS.index(1.0)]:.2f} rad (rms) from their source",
        x_label="time (s)",
        y_label="q (rad)",
        height=3.9,
    )
    strengths = np.array(STRENGTHS)
    by_strength = lines_figure(
        {"": {"mean distance": Line(strengths, distance, NORMAL, "o")}},
        title=f"From the source: {distance[0]:.2f} rad at s = 0, {distance[-1]:.2f} rad at s = {STRENGTHS[-1]:g}",
        x_label="strength of the perturbation s (posterior σ)",
        y_label="rms distance from the source (rad)",
        ticks=strengths,
        from_zero=True,
    )
    rows = tuple(
        (
            f"s = {each.s:g}",
            str(len(each.motions)),
            f"{each.truly_cool:.1%}",
            f"{mean:.3f}",
            f"{np.mean([m.distance_z for m in each.motions]):.2f}",
            ", ".join(f"{reason} {n}" for reason, n in each.rejected.items()) or "none",
        )
        for each, mean in zip(made, distance, strict=True)
    )
    return Section(
        sentences=sentences,
        how="Windows of cool training jobs, latent perturbed as mu + s·eps·sigma, positions decoded, joined, smoothed "
        "and slowed down to the limits, torque from inverse dynamics. A motion passes if the nominal thermal network "
        "predicts that it stays cool and MuJoCo performs it. The true motors are only measured afterwards.",
        pictures=(
            picture("motions", motions, "Joint angles of a source and of generated motions."),
            picture("distance", by_strength, "Distance against s. " + sentences[1]),
        ),
        tables=(
            Table(head=("strength", "accepted", "truly cool", "distance, rad", "distance, σ", "rejected"), rows=rows),
        ),
        numbers={
            "s": list(STRENGTHS),
            "distance_rad": distance,
            "truly_cool": [each.truly_cool for each in made],
            "rejected": [dict(each.rejected) for each in made],
        },
    )


def recovery_chapter(lab: Lab) -> Section:
    """A warm arm that holds a payload moves to an easier posture."""
    lab.progress("recovering", 0.0)
    study = lab.study
    arm, q = bare_arm(study.robot, study.motors, study.thermal), np.array(POSTURES[POSTURE])
    result = recover(
        lab.twin,
        arm,
        q,
        HOLD_KG,
        start_c=hold_until(arm, q, HOLD_KG, ambient_c=study.ambient_c, until_c=WARM_C),
        verification=Verification.nominal(study.robot, study.ambient_c),
        seed=lab.seeds[0],
    )
    hot = result.hottest
    with_c, without_c = result.with_c[:, hot], result.without_c[:, hot]
    finding = (
        f"Joint {hot + 1} cools from {with_c[0]:.1f} °C to {with_c[-1]:.1f} °C in ten minutes with the change of "
        f"posture; without, it would be at {without_c[-1]:.1f} °C. The tool moved {100 * result.tool_m:.0f} cm. Load "
        f"difficulty of the joint: {result.difficulty_before[hot]:.2f}, then {result.difficulty_after[hot]:.2f}."
    )
    title = (
        f"After the change of posture the hottest motor cools by {result.cooled_k:.1f} K"
        if result.cooled_k > 0
        else f"With the change of posture the hottest motor ends {result.spared_k:.1f} K cooler than without"
    )
    drawn = lines_figure(
        {
            "": {
                f"joint {hot + 1}, same posture": Line(result.time_s / 60, without_c, CRITICAL),
                f"joint {hot + 1}, easier posture": Line(result.time_s / 60, with_c, NORMAL),
            }
        },
        title=title,
        x_label="time (min)",
        y_label="motor temperature (°C)",
        level=(study.warning_c, f"warning limit, {study.warning_c:g} °C"),
    )
    return Section(
        sentences=(finding,),
        how=f"The arm holds {HOLD_KG:g} kg in posture '{POSTURE}' until the hottest motor is at {WARM_C:g} °C. The "
        "twin's one-sided torque difficulty ranks nearby postures; the best reachable one is performed in MuJoCo, with "
        "the true motors of the studied arm.",
        pictures=(picture("recovery", drawn, "Temperature with and without. " + finding),),
        numbers={
            "time_s": result.time_s,
            "with_c": with_c,
            "without_c": without_c,
            "cooled_k": result.cooled_k,
            "spared_k": result.spared_k,
        },
    )
