"""Chairs and sofas."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    arc,
    bar,
    bevel_box,
    board,
    box,
    cushion,
    ellipse,
    frustum,
    mirrored,
    revolve,
    rounded,
    sheet,
    slab,
    taper_box,
    tube,
)
from ocnf_data.shapes.supports import four_legs, star_base


def chair(draw: Draw) -> list[Part]:
    """Side chairs, armchairs, stools, swivel and cantilever chairs, moulded shells."""
    w, d, h = draw.between(0.38, 0.56), draw.between(0.38, 0.54), draw.between(0.40, 0.50)
    if draw.chance(0.15):
        return [*_shell(draw, w, d, h), *_chair_base(draw, w * 0.8, d * 0.8, h)]
    base = _chair_base(draw, w, d, h)
    stool = draw.chance(0.07)
    back = [] if stool else _back(draw, w, d, h, draw.between(0.38, 0.62))
    arms = _arms(draw, w, d, h) if not stool and draw.chance(0.4) else []
    return [*_seat(draw, w, d, h), *base, *back, *arms]


def _seat(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    match draw.pick("board", "cushion", "round", "woven", "padded"):
        case "board":
            return [bevel_box(w, d, 0.035, 0.008).move(z=h)]
        case "cushion":
            core = box(w * 0.7, d * 0.7, 0.03).move(z=h + 0.03)  # the wood inside the upholstery
            return [cushion(w, d, draw.between(0.07, 0.12), draw.between(3, 8)).move(z=h - 0.01), core]
        case "round":
            outline = ellipse(w / 2, d / 2, 28, draw.pick(2.0, 2.5, 4.0))
            return [slab(outline, 0.04, 0.01).move(z=h)]
        case "woven":
            x, y = np.meshgrid(np.linspace(-w / 2, w / 2, 12), np.linspace(-d / 2, d / 2, 12))
            sag = -0.03 * (1 - (2 * x / w) ** 2) * (1 - (2 * y / d) ** 2)
            frame = rounded(
                [(w / 2, -d / 2, h), (w / 2, d / 2, h), (-w / 2, d / 2, h), (-w / 2, -d / 2, h)],
                0.04,
                loop=True,
            )
            return [sheet(np.stack([x, y, h + sag], axis=-1)), tube(frame, 0.013, loop=True)]
        case _:
            pad = cushion(w * 0.94, d * 0.94, 0.06, 6).move(z=h + 0.02)
            return [bevel_box(w, d, 0.03, 0.006).move(z=h), pad]


def _chair_base(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    match draw.pick("legs", "legs", "legs", "star", "sled", "cantilever", "pedestal"):
        case "star":
            return star_base(draw, h)
        case "sled":
            x, y = w / 2 - 0.02, d / 2 - 0.02
            path = rounded([(x, -y, h), (x, -y - 0.02, 0.012), (x, y + 0.02, 0.012), (x, y, h)], 0.05)
            cross = [bar((-x, s * y, h - 0.01), (x, s * y, h - 0.01), 0.010) for s in (-1, 1)]
            return [*mirrored([tube(path, 0.011)]), *cross]
        case "cantilever":
            x, y = w / 2 - 0.02, d / 2
            path = rounded(
                [
                    (x, y, h),
                    (x, -y, h),
                    (x, -y - 0.02, 0.015),
                    (x, y, 0.015),
                    (-x, y, 0.015),
                    (-x, -y - 0.02, 0.015),
                    (-x, -y, h),
                    (-x, y, h),
                ],
                0.07,
            )
            return [tube(path, 0.013)]
        case "pedestal":
            r = draw.between(0.17, 0.24)
            profile = [
                (0, 0),
                (r, 0),
                (r, 0.02),
                (0.05, 0.05),
                (0.03, 0.15),
                (0.035, h - 0.02),
                (0.12, h + 0.005),
                (0, h + 0.005),
            ]
            return [revolve(profile, 28)]
    return four_legs(draw, w, d, h + 0.01, draw.between(0.016, 0.026))


def _back(draw: Draw, w: float, d: float, h: float, tall: float) -> list[Part]:
    """The back is built upright at y = 0, then leaned back and set on the rear edge of the seat."""
    bow = draw.between(0, 0.05)
    post = draw.between(0.012, 0.02)
    style = draw.pick("panel", "slats", "ladder", "hoop", "pad", "cross", "sheet")
    x = w / 2 - post
    posts = mirrored(
        [tube([(x, 0, -0.03), (x, 0, tall)], post, section=ellipse(1, 1, 8, draw.pick(2.0, 6.0)))]
    )
    rail = board(w - post, draw.between(0.05, 0.09), 0.02, 8, bow, draw.between(0, 0.03)).move(z=tall - 0.06)
    match style:
        case "panel":
            parts = [board(w, tall, 0.02, 10, bow, draw.between(0, 0.08))]
        case "sheet":
            parts = [*posts, board(w - 2 * post, tall * 0.6, 0, 10, bow).move(z=tall * 0.35)]
        case "slats":
            n = draw.count(3, 9)
            slat = box((w - 0.06) / n * draw.between(0.3, 0.7), 0.012, tall - 0.04)
            places = np.linspace(-x, x, n + 2)[1:-1]
            parts = [*posts, rail, *(slat.move(x=p, y=bow * (1 - (2 * p / w) ** 2), z=0.01) for p in places)]
        case "ladder":
            n = draw.count(2, 5)
            rung = board(w - post, tall / n * draw.between(0.25, 0.6), 0.015, 8, bow, draw.between(0, 0.02))
            parts = [*posts, *(rung.move(z=tall * (0.1 + 0.88 * i / n)) for i in range(n)), rail]
        case "hoop":
            path = arc(
                [
                    (x, 0, -0.02),
                    (x * 1.1, 0.02, tall * 0.5),
                    (x * 0.7, bow, tall * 0.92),
                    (0, bow, tall),
                    (-x * 0.7, bow, tall * 0.92),
                    (-x * 1.1, 0.02, tall * 0.5),
                    (-x, 0, -0.02),
                ],
                30,
            )
            n = draw.count(3, 8)
            spindles = [
                bar((t * x, 0, 0), (1.1 * t * x, bow * 0.8, tall * (0.99 - 0.28 * t * t)), 0.006)
                for t in np.linspace(-0.75, 0.75, n)
            ]
            parts = [tube(path, post), *spindles]
        case "cross":
            arms = [
                bar((-x, 0, 0.05), (x, 0, tall - 0.05), 0.011),
                bar((x, 0, 0.05), (-x, 0, tall - 0.05), 0.011),
            ]
            parts = [*posts, *arms, rail]
        case _:
            gap = draw.between(0.05, 0.2)
            pad = cushion(w * 0.95, draw.between(0.05, 0.1), tall - gap, 5).move(z=gap)
            parts = [pad, *mirrored([box(0.03, 0.015, gap + 0.1).move(x=w * 0.25, z=-0.02)])]
    lean = draw.between(-16, -2)
    return [p.turn("x", lean).move(y=d / 2 - 0.02, z=h + 0.02) for p in parts]


def _arms(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    x, y, up = w / 2 + 0.01, d / 2, draw.between(0.17, 0.26)
    match draw.pick("posts", "loop", "panel"):
        case "posts":
            rest = bevel_box(draw.between(0.035, 0.07), d, 0.022, 0.006).move(x=x, z=h + up)
            return mirrored(
                [
                    rest,
                    bar((x, -y * 0.7, h - 0.02), (x, -y * 0.8, h + up + 0.01), 0.013),
                    bar((x, y * 0.8, h - 0.02), (x, y * 0.8, h + up + 0.01), 0.013),
                ]
            )
        case "loop":
            path = rounded(
                [
                    (x - 0.02, -y * 0.6, h),
                    (x + 0.02, -y * 0.8, h + up),
                    (x + 0.02, y * 0.8, h + up),
                    (x - 0.02, y * 0.9, h),
                ],
                0.07,
            )
            return mirrored([tube(path, 0.012)])
        case _:
            return mirrored([bevel_box(0.05, d, up + 0.06, 0.01).move(x=x + 0.015, z=h - 0.03)])


def _shell(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    """Seat and back moulded as one bent sheet, open and without thickness."""
    tall = draw.between(0.3, 0.5)
    line = arc(
        [
            (0, -d / 2, h - 0.02),
            (0, -d / 4, h + 0.005),
            (0, d / 3, h),
            (0, d / 2, h + 0.08),
            (0, d / 2 + 0.06, h + tall * 0.6),
            (0, d / 2 + 0.1, h + tall),
        ],
        24,
    )
    u = np.linspace(-1, 1, 17)
    width = w / 2 * (1 - 0.25 * np.linspace(-0.6, 1, 24) ** 2)
    curl = draw.between(0.02, 0.12) * np.sin(np.linspace(0.3, np.pi, 24))
    x = width[:, None] * u
    y = line[:, 1:2] - 0.3 * curl[:, None] * u**2
    z = line[:, 2:3] + curl[:, None] * u**4
    return [sheet(np.stack([x, y, z], axis=-1)), frustum(0.09, 0.12, 0.03).move(z=h - 0.025)]


def sofa(draw: Draw) -> list[Part]:
    """Sofas of one to four seats, some with a chaise, on a plinth or on legs."""
    n = draw.count(1, 4)
    seat_w, d = draw.between(0.55, 0.75), draw.between(0.75, 0.95)
    w, arm = n * seat_w, draw.between(0.08, 0.25)
    lift, seat_h = draw.pick(0.02, draw.between(0.08, 0.18)), draw.between(0.36, 0.46)
    arm_h, back_h = seat_h + draw.between(0.05, 0.28), draw.between(0.70, 0.95)
    power, back_t = draw.between(4, 10), draw.between(0.12, 0.22)
    full = w + 2 * arm
    base_h = seat_h - 0.14 - lift
    parts = [
        bevel_box(full, d, base_h, 0.02).move(z=lift),
        box(w * 0.9, d * 0.6, base_h * 0.6).move(z=lift + 0.02),
    ]
    lean = draw.between(-12, 0)
    parts.append(bevel_box(full, back_t, back_h - lift, 0.04).move(y=d / 2 - back_t / 2, z=lift))
    for i in range(n):
        x = (i + 0.5) * seat_w - w / 2
        parts.append(
            cushion(seat_w - 0.01, d - back_t, 0.18, power).move(x=x, y=-back_t / 2, z=seat_h - 0.16)
        )
        rest = cushion(seat_w - 0.02, 0.2, back_h - seat_h + draw.between(-0.05, 0.05), power)
        parts.append(rest.turn("x", lean).move(x=x, y=d / 2 - back_t - 0.07, z=seat_h - 0.02))
    x = w / 2 + arm / 2
    match draw.pick("block", "roll", "slope", "frame", "none"):
        case "block":
            parts += mirrored([bevel_box(arm, d, arm_h - lift, 0.03).move(x=x, z=lift)])
        case "roll":
            r = arm * 0.62
            roll = frustum(r, r, d, 20).turn("x", 90).move(x=x, y=d / 2, z=arm_h - r)
            parts += mirrored([box(arm * 0.7, d, arm_h - r - lift).move(x=x, z=lift), roll])
        case "slope":
            side = taper_box(arm, d, arm_h - lift, draw.between(0.6, 0.9)).move(x=x, z=lift)
            parts += mirrored([side])
        case "frame":
            y = d / 2 - 0.03
            path = rounded([(x, -y, 0.01), (x, -y, arm_h), (x, y, arm_h), (x, y, 0.01)], 0.05)
            parts += mirrored([tube(path, 0.018)])
    if draw.chance(0.25):
        reach = draw.between(0.5, 0.8)
        x, y = draw.pick(-1, 1) * (w / 2 - seat_w / 2), -d / 2 - reach / 2
        parts.append(bevel_box(seat_w, reach + 0.05, base_h, 0.02).move(x=x, y=y, z=lift))
        parts.append(cushion(seat_w, reach + 0.05, 0.18, power).move(x=x, y=y, z=seat_h - 0.16))
    if lift > 0.05:
        leg = frustum(draw.between(0.012, 0.025), 0.03, lift + 0.02, 10)
        parts += mirrored([leg.move(x=full / 2 - 0.08, y=s * (d / 2 - 0.08)) for s in (-1, 1)])
    for _ in range(draw.count(0, 3)):
        pillow = (
            cushion(0.42, 0.14, 0.42, 2.8).turn("x", draw.between(-35, -15)).turn("z", draw.between(-30, 30))
        )
        parts.append(pillow.move(x=draw.between(-0.4, 0.4) * w, y=d / 2 - back_t - 0.26, z=seat_h + 0.02))
    return parts
