"""Motion out of the twin, chapter by chapter: generated near what it knows, and away from what heats."""

import numpy as np

from fleet.difficulty import Blind
from fleet.robot import POSTURES
from fleet.sim.models import ArmModel
from fleet.sim.world import Arm
from scenarios.generate import Verification, generate
from scenarios.quality import CARRIER
from scenarios.recover import recover, warmed
from scenarios.twin_charts import courses_figure, curves_figure, motions_figure
from scenarios.twin_lab import Lab
from scenarios.twin_page import Picture, Section, Table
from scenarios.twin_style import CRITICAL, NORMAL, png

Array = np.ndarray

STRENGTHS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Of the perturbation, in posterior standard deviations."""
SHOWN = 4
HOLD_KG, WARM_C = 2.5, 50.0
POSTURE = "raised"


def true_arm(lab: Lab) -> Arm:
    """The studied arm as the simulator has it."""
    robot, study = lab.study.robot, lab.study
    rest_tau = ArmModel(robot).gravity_torque(robot.home_q())
    return Arm(robot=robot, motors=study.motors, thermal=study.thermal, rest_tau=rest_tau, model=Blind(), plans={})


def generation_chapter(lab: Lab) -> Section:
    """Generated motions and how far they are from the data."""
    study = lab.study
    asked = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    arm, made = true_arm(lab), []
    for done, s in enumerate(STRENGTHS):
        lab.progress("generating", done / len(STRENGTHS))
        made.append(
            generate(
                lab.twin, arm, study.train.plans, s=s, count=lab.size.generated, seed=lab.seeds[0], verification=asked
            )
        )
    distance = np.array([np.mean([motion.distance_rad for motion in each.motions]) for each in made])
    cool = float(np.mean([motion.peak_c.max() < study.cool_c for each in made for motion in each.motions]))
    handed = sum(len(each.motions) for each in made)
    drawn_in_all = sum(each.draws for each in made)
    sentences = (
        f"{handed} motions were handed out, {drawn_in_all - handed} of {drawn_in_all} made up were rejected before. "
        f"All "
        f"that were handed out were performed in MuJoCo within the tracking bound; {cool:.1%} truly stay below "
        f"{study.cool_c:g} °C over the horizon (target 95 %).",
        f"At s = {STRENGTHS[1]:g} they lie {distance[1]:.3f} rad from their source (rms over joints and time), at "
        f"s = {STRENGTHS[-1]:g} {distance[-1]:.3f} rad; at s = 0 {distance[0]:.3f} rad, what reconstruction alone "
        f"loses.",
    )
    near = made[STRENGTHS.index(1.0)].motions
    # Of the source that moves most: a hold shows little.
    source = max(
        (motion.source for motion in near), key=lambda plan: float(np.ptp(plan.cycle.profile[:, 0], axis=0).max())
    )
    same = [motion for motion in near if motion.source is source][:SHOWN]
    rows = tuple(
        (
            f"s = {each.s:g}",
            str(len(each.motions)),
            f"{each.truly_cool:.1%}",
            f"{d:.3f}",
            f"{np.mean([m.distance_z for m in each.motions]):.2f}",
            ", ".join(f"{reason} {n}" for reason, n in each.rejected.items()) or "none",
        )
        for each, d in zip(made, distance, strict=True)
    )
    how_far = curves_figure(
        np.array(STRENGTHS),
        {"mean distance": distance},
        title=f"From the source: {distance[0]:.2f} rad at s = 0, {distance[-1]:.2f} rad at s = {STRENGTHS[-1]:g}",
        x_label="strength of the perturbation s (posterior σ)",
        y_label="rms distance from the source (rad)",
    )
    motions = motions_figure(
        source.cycle.profile[:, 0],
        [motion.plan.cycle.profile[:, 0] for motion in same],
        50.0,
        joints=(0, CARRIER, 3, 5),
        title=f"At s = 1 generated motions lie {distance[STRENGTHS.index(1.0)]:.2f} rad (rms) from their source",
    )
    return Section(
        key="generation",
        title="Generated motions",
        sentences=sentences,
        how="Windows of cool training jobs, latent perturbed as mu + s·eps·sigma, positions decoded, joined and "
        "smoothed, slowed down to the limits, torque from inverse dynamics; predicted to stay cool by the nominal "
        "thermal network, performed in MuJoCo, rejected else. The true motors judge afterwards and decide nothing.",
        pictures=(
            Picture(name="motions", png=png(motions), alt="Joint angles of a source and of generated motions."),
            Picture(name="distance", png=png(how_far), alt="Distance against s. " + sentences[1]),
        ),
        tables=(
            Table(head=("strength", "handed out", "truly cool", "distance, rad", "distance, σ", "rejected"), rows=rows),
        ),
        numbers={
            "s": list(STRENGTHS),
            "distance_rad": distance.tolist(),
            "truly_cool": [each.truly_cool for each in made],
            "rejected": [dict(each.rejected) for each in made],
        },
    )


def recovery_chapter(lab: Lab) -> Section:
    """A warm arm that holds a payload takes an easier posture."""
    lab.progress("recovering", 0.0)
    study, arm = lab.study, true_arm(lab)
    q = np.array(POSTURES[POSTURE])
    start_c = warmed(arm, q, HOLD_KG, ambient_c=study.ambient_c, until_c=WARM_C)
    found = recover(
        lab.twin,
        arm,
        q,
        HOLD_KG,
        start_c=start_c,
        verification=Verification.nominal(study.robot, study.ambient_c),
        seed=lab.seeds[0],
    )
    hot = found.hottest
    sentence = (
        f"Joint {hot + 1}, at {found.with_c[0, hot]:.1f} °C, is at {found.with_c[-1, hot]:.1f} °C ten minutes after "
        f"the "
        f"change of posture, and would be at {found.without_c[-1, hot]:.1f} °C without; the tool moved "
        f"{100 * found.tool_m:.0f} cm. Load difficulty of the joint: {found.difficulty_before[hot]:.2f} before, "
        f"{found.difficulty_after[hot]:.2f} after."
    )
    title = (
        f"After the change of posture the hottest motor cools by {found.cooled_k:.1f} K"
        if found.cooled_k > 0
        else f"The change of posture spares the hottest motor {found.spared_k:.1f} K"
    )
    drawn = courses_figure(
        found.time_s / 60,
        {
            f"joint {hot + 1}, holding on": (found.without_c[:, hot], CRITICAL),
            f"joint {hot + 1}, easier posture": (found.with_c[:, hot], NORMAL),
        },
        title=title,
        limit_c=study.warning_c,
    )
    return Section(
        key="recovery",
        title="Posture recovery",
        sentences=(sentence,),
        how=f"Holding {HOLD_KG:g} kg in posture '{POSTURE}' until the hottest motor is at {WARM_C:g} °C; the twin's "
        "one-sided torque difficulty ranks nearby postures, the best that can be reached is performed in MuJoCo, with "
        "the true motors of the studied arm.",
        pictures=(Picture(name="recovery", png=png(drawn), alt="Temperature with and without. " + sentence),),
        numbers={
            "time_s": found.time_s.tolist(),
            "with_c": found.with_c[:, hot].tolist(),
            "without_c": found.without_c[:, hot].tolist(),
            "cooled_k": found.cooled_k,
            "spared_k": found.spared_k,
        },
    )
