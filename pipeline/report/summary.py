"""Answers with their errors -> tables for the terminal."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from pipeline.items.errors import CORRECT_MSSD, PoseErrors
from pipeline.items.poses import NoEstimate, PoseEstimate
from pipeline.items.records import Answer

AnswerWithErrors = tuple[Answer, PoseErrors | None]
"""Errors are None without a pose or without ground truth."""

_MAX_REASONS = 12
ROUTINE_NOTE = "epipolar check skipped"  # usual for near-planar sets; poses.json has it


def answers_table(rows: Sequence[AnswerWithErrors]) -> str:
    """One line per answer: its errors against ground truth, or why there is no pose."""
    lines = [
        f"{'scene':>5}{'image':>7}{'object':>7}{'rot. error':>12}{'transl. error':>15}{'MSSD/diam':>11}{'inliers':>9}"
        f"{'reproj.':>9}{'time':>8}  notes"
    ]
    for answer, errors in rows:
        head = f"{answer.scene_id:>5}{answer.im_id:>7}{answer.obj_id:>7}"
        if isinstance(answer, NoEstimate):
            lines.append(f"{head}  no pose: {answer.stage}: {answer.reason}")
            continue
        lines.append(head + _error_cells(errors) + _estimate_cells(answer))
        if errors is None:
            R, t = answer.T_cam_obj[:3, :3].round(4).tolist(), answer.T_cam_obj[:3, 3].round(1).tolist()
            lines.append(f"       t {t} mm, R {R} (object to camera)")
    return "\n".join(lines)


def _error_cells(errors: PoseErrors | None) -> str:
    if errors is None:
        return f"{'-':>12}{'-':>15}{'-':>11}"
    rotation = f"{errors.symmetric_rotation_deg:>8.1f} deg"
    return f"{rotation}{errors.translation_mm:>12.0f} mm{errors.relative_mssd:>10.0%} "


def _estimate_cells(answer: PoseEstimate) -> str:
    reprojection = "-" if answer.reprojection_px is None else f"{answer.reprojection_px:.2f} px"
    shown = [part for note in answer.notes for part in note.split("; ") if not part.startswith(ROUTINE_NOTE)]
    notes = "; ".join([*shown, *([f"fallback: {answer.fallback}"] if answer.fallback else [])])
    inliers = f"{answer.inliers}/{answer.correspondences}"
    return f"{inliers:>9}{reprojection:>9}{sum(answer.times_s.values()):>6.2f} s  {notes}"


def objects_table(rows: Sequence[AnswerWithErrors]) -> str:
    """One line per object: numbers of answers and poses, and median errors; the last line is over all objects."""
    groups: defaultdict[int, list[AnswerWithErrors]] = defaultdict(list)
    for answer, errors in rows:
        groups[answer.obj_id].append((answer, errors))
    lines = [
        f"{'object':>6}{'answers':>9}{'poses':>7}{'rot. error':>12}{'transl. error':>15}{'MSSD/diam':>11}{'correct':>9}"
    ]
    for name, group in [*sorted(groups.items()), ("all", list(rows))]:
        poses = sum(not isinstance(answer, NoEstimate) for answer, _ in group)
        known = [errors for _, errors in group if errors is not None]
        line = f"{name:>6}{len(group):>9}{poses:>7}"
        if known:
            line += f"{np.median([e.symmetric_rotation_deg for e in known]):>8.1f} deg"
            line += f"{np.median([e.translation_mm for e in known]):>12.0f} mm"
            line += f"{np.median([e.relative_mssd for e in known]):>11.0%}"
            line += f"{sum(e.looks_right for e in known) / len(group):>9.0%}"
        lines.append(line)
    note = f"medians over poses; correct: share of all answers with MSSD below {CORRECT_MSSD:.0%} of the diameter"
    return "\n".join([*lines, note])


def counts_text(answers: Sequence[Answer]) -> str:
    """How many answers are poses."""
    failures = sum(isinstance(answer, NoEstimate) for answer in answers)
    return f"poses found: {len(answers) - failures}, failed: {failures}{' (each with its reason)' if failures else ''}"


def failures_table(missing: Sequence[NoEstimate]) -> str:
    """Number of answers without a pose, by stage and reason, the most frequent first."""
    counts = Counter((answer.stage, answer.reason) for answer in missing)
    shown = counts.most_common(_MAX_REASONS)
    lines = ["without a pose:"] + [f"{count:>6}  {stage}: {reason}" for (stage, reason), count in shown]
    rest = sum(counts.values()) - sum(count for _, count in shown)
    return "\n".join(lines + ([f"{rest:>6}  other reasons, see poses.json"] if rest else []))
