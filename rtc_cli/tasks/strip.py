"""The strip below a picture: which chunk acts around the step shown, and when inference ran.

.. code-block:: text

    |  1  |  1  |  2  |  2  |  2  |  2  |  3  |  3  |   one cell per control step: the acting chunk
                |=====2=====|           now             an inference, in the colour of its chunk,
                                                        from its start until the chunk can be used

The step that is shown stays in the middle; what lies ahead is paler. Below run the step, who acts,
and a line that says how much of the episode has passed.
"""

from __future__ import annotations

from functools import cache
from itertools import groupby

from PIL import Image, ImageDraw, ImageFont

from rtc_cli.tasks.drawing import BACKGROUND, FAINT, INK, Color, darker, mixed
from rtc_cli.tasks.scene import Status
from rtc_cli.tasks.trace import Trace

STATUS_NAMES: dict[Status, str] = {
    Status.RUNNING: "running",
    Status.SOLVED: "solved",
    Status.FAILED: "failed",
    Status.TIMEOUT: "out of time",
    Status.INVALID: "invalid",
}
STATUS_COLORS: dict[Status, Color] = {
    Status.SOLVED: (0, 128, 92),
    Status.FAILED: (180, 60, 0),
    Status.TIMEOUT: (96, 100, 108),
    Status.INVALID: (96, 100, 108),
}
CHUNK_COLORS: tuple[Color, ...] = ((122, 160, 210), (186, 156, 208), (216, 196, 136))
HOLD_COLOR: Color = (200, 202, 206)
CURSOR: Color = (200, 30, 90)
SPAN = 24  # control steps that the strip shows
AHEAD = 0.4  # strength of the colours of steps that lie ahead
PAD, LANE, GAP, INFERENCE, TEXT = 8, 15, 3, 8, 22


def draw_strip(trace: Trace, tick: int, width: int, step_s: float) -> Image.Image:
    """The strip after `tick` control steps of `step_s` seconds."""
    lanes = PAD + LANE + GAP + INFERENCE if trace.chunked else 0
    image = Image.new("RGB", (width, lanes + PAD + TEXT), BACKGROUND)
    draw = ImageDraw.Draw(image)
    if trace.chunked:
        _draw_lanes(draw, trace, tick, width)
    _draw_words(draw, trace, tick, width, lanes + PAD // 2, step_s)
    passed = (width - 2 * PAD) * tick / trace.ticks
    bottom = image.height - 5
    draw.rectangle((PAD, bottom, width - PAD, bottom + 2), fill=FAINT)
    draw.rectangle((PAD, bottom, PAD + passed, bottom + 2), fill=INK)
    return image


def _draw_lanes(draw: ImageDraw.ImageDraw, trace: Trace, tick: int, width: int) -> None:
    """The acting chunks, the inferences below them, and the line of now."""
    cell = (width - 2 * PAD) / SPAN
    first = tick - SPAN // 2

    def at(step: float) -> int:
        return round(PAD + cell * min(max(step - first, 0), SPAN))

    shown = range(max(first, 0), min(first + SPAN, trace.ticks))
    bottom = PAD + LANE
    for step in shown:
        color = chunk_color(int(trace.chunk[step]), ahead=step >= tick)
        draw.rectangle((at(step), PAD, at(step + 1) - 2, bottom), fill=color)
    for chunk, steps in groupby(shown, key=lambda step: int(trace.chunk[step])):
        run = list(steps)
        _centred(draw, at(run[0]), at(run[-1] + 1) - 2, PAD + 1, "" if chunk < 0 else str(chunk))
    top = bottom + GAP
    for number, (start, ready) in enumerate(trace.inferences, 1):
        if max(start, first) < min(max(ready, start + 1), first + SPAN, trace.ticks):
            color = darker(chunk_color(number))
            color = mixed(color, BACKGROUND, AHEAD) if start >= tick else color
            # An inference that takes no time is a mark as wide as a third of a step.
            end = max(at(min(ready, trace.ticks)) - 2, at(start) + round(cell / 3))
            draw.rectangle((at(start), top, end, top + INFERENCE), fill=color)
    draw.line((at(tick) - 1, PAD // 2, at(tick) - 1, top + INFERENCE + 2), fill=CURSOR, width=2)


def chunk_color(chunk: int, ahead: bool = False) -> Color:
    """Neighbouring chunks differ; what lies ahead is paler."""
    color = HOLD_COLOR if chunk < 0 else CHUNK_COLORS[chunk % len(CHUNK_COLORS)]
    return mixed(color, BACKGROUND, AHEAD) if ahead else color


def _centred(draw: ImageDraw.ImageDraw, left: int, right: int, top: int, text: str) -> None:
    """Small text between two columns, where there is room for it."""
    length = draw.textlength(text, font=font(11))
    if text and length + 2 <= right - left:
        draw.text(((left + right - length) / 2, top), text, fill=INK, font=font(11))


def _draw_words(
    draw: ImageDraw.ImageDraw, trace: Trace, tick: int, width: int, top: int, step_s: float
) -> None:
    """The step and the outcome on the left, who acts on the right if there is room."""
    text = f"step {tick}, {tick * step_s:.1f} s"
    draw.text((PAD, top), text, fill=INK, font=font(13))
    end = PAD + draw.textlength(text, font=font(13))
    if tick == trace.ticks:
        end += PAD + _draw_badge(draw, end + PAD, top, trace.status)
    left = width - PAD - draw.textlength(trace.caption, font=font(13))
    if left > end + PAD:
        draw.text((left, top), trace.caption, INK, font(13))


def draw_outcome(picture: Image.Image, status: Status) -> None:
    """A frame round the last picture of an episode, in the colour of its outcome."""
    edges = (0, 0, picture.width - 1, picture.height - 1)
    ImageDraw.Draw(picture).rectangle(edges, outline=STATUS_COLORS[status], width=3)


def _draw_badge(draw: ImageDraw.ImageDraw, left: float, top: int, status: Status) -> float:
    """The outcome in words; returns its width."""
    text = STATUS_NAMES[status]
    length = draw.textlength(text, font=font(13)) + 12
    draw.rectangle((left, top - 1, left + length, top + 16), fill=STATUS_COLORS[status])
    draw.text((left + 6, top), text, fill=(255, 255, 255), font=font(13))
    return length


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The letters that come with Pillow."""
    return ImageFont.load_default(size)
