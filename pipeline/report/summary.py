"""answers, errors -> tables for the terminal."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from pipeline.items.poses import NoEstimate
from pipeline.items.records import Answer
from pipeline.items.scores import CORRECT_MSSD, PoseErrors

Checked = tuple[Answer, PoseErrors | None]


def answers_table(rows: Sequence[Checked]) -> str:
    """A line per answer: its errors against the ground truth, or why there is no pose."""
    lines = [
        f"{'scene':>5}{'image':>7}{'object':>7}{'rotation':>10}{'shift':>9}{'MSSD/diam':>11}{'inliers':>9}"
        f"{'reproj.':>9}{'time':>8}  notes"
    ]
    for answer, judged in rows:
        head = f"{answer.scene_id:>5}{answer.im_id:>7}{answer.obj_id:>7}"
        if isinstance(answer, NoEstimate):
            lines.append(f"{head}  no pose: {answer.stage}: {answer.reason}")
            continue
        errors = f"{'-':>10}{'-':>9}{'-':>11}"
        if judged is not None:
            errors = f"{judged.symmetric_rotation_deg:>6.1f} deg{judged.translation_mm:>6.0f} mm"
            errors += f"{judged.relative_mssd:>10.0%} "
        reprojection = "-" if answer.reprojection_px is None else f"{answer.reprojection_px:.2f} px"
        seconds = sum(answer.times_s.values())
        notes = "; ".join([*answer.notes, *([f"fallback: {answer.fallback}"] if answer.fallback else [])])
        inliers = f"{answer.inliers}/{answer.correspondences}"
        lines.append(f"{head}{errors}{inliers:>9}{reprojection:>9}{seconds:>6.2f} s  {notes}")
        if judged is None:
            R, t = answer.T_cam_obj[:3, :3].round(4).tolist(), answer.T_cam_obj[:3, 3].round(1).tolist()
            lines.append(f"       t {t} mm, R {R} (object to camera)")
    return "\n".join(lines)


def objects_table(rows: Sequence[Checked]) -> str:
    """A line per object: how many answers, poses, and the medians of their errors."""
    groups: defaultdict[int, list[Checked]] = defaultdict(list)
    for answer, judged in rows:
        groups[answer.obj_id].append((answer, judged))
    lines = [f"{'object':>6}{'answers':>9}{'poses':>7}{'rotation':>12}{'shift':>9}{'MSSD/diam':>11}{'right':>8}"]
    for obj_id, mine in [*sorted(groups.items()), ("all", list(rows))]:
        poses = sum(not isinstance(answer, NoEstimate) for answer, _ in mine)
        errors = [j for _, j in mine if j is not None]
        line = f"{obj_id:>6}{len(mine):>9}{poses:>7}"
        if errors:
            relative = np.array([j.relative_mssd for j in errors])
            line += f"{np.median([j.symmetric_rotation_deg for j in errors]):>8.1f} deg"
            line += f"{np.median([j.translation_mm for j in errors]):>6.0f} mm{np.median(relative):>11.0%}"
            line += f"{sum(j.looks_right for j in errors) / len(mine):>8.0%}"
        lines.append(line)
    return "\n".join(
        [*lines, f"medians over poses; right: share of all answers with MSSD below {CORRECT_MSSD:.0%} of the diameter"]
    )


def failures_table(missing: Sequence[NoEstimate]) -> str:
    """How many answers have no pose, by stage and the first words of the reason."""
    counts = Counter((answer.stage, answer.reason) for answer in missing)
    shown = counts.most_common(12)
    lines = ["without a pose:"] + [f"{count:>6}  {stage}: {reason}" for (stage, reason), count in shown]
    rest = sum(counts.values()) - sum(count for _, count in shown)
    return "\n".join(lines + ([f"{rest:>6}  other reasons, see poses.json"] if rest else []))
