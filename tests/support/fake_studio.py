"""A studio and a page without a method and without a browser, by a clock that stands."""

import torch

from forewarp.viewer.desk import Desk, Superseded
from tests.support.tiny_scene import ball_scene

CANVAS = 640, 480


class Watch:
    """A clock that stands unless it is moved on."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


class FakeStudio:
    """Draws grey pictures; each takes ``cost`` seconds a pixel, of a clock that stands otherwise."""

    size, note, follows = 400, "", True

    def __init__(self, watch, cost=0.0):
        self.watch, self.cost, self.scene = watch, cost, ball_scene(frames=4)
        self.desk, self.subjects = Desk(watch), [self]
        self.looks, self.interrupt = [], None

    def known(self, look):
        return look

    def prepare(self, look):
        self.watch.now += 0.001

    def picture(self, look, width, height, stale, parts=1):
        self.looks.append(look)
        self.watch.now += self.cost * width * height
        if self.interrupt:
            self.interrupt()
            if stale():
                raise Superseded
        return torch.full((height, width, 3), look.time)

    def ellipsoids(self, time):
        return f"splats at {time}"

    def point_at(self, look, x, y, width, height):
        return None if x > 0.9 else (x, y, 0.0)


class FakePage:
    """Keeps what it is shown and told."""

    def __init__(self):
        self.pictures, self.said, self.times, self.plays = [], [], [], []

    def canvas(self):
        return CANVAS

    def show(self, picture, *, rest):
        self.pictures.append((tuple(picture.shape[:2]), rest, round(float(picture[0, 0, 0]), 3)))

    def splats(self, ellipsoids):
        self.pictures.append(ellipsoids)

    def tell(self, text):
        self.said.append(text)

    def time_is(self, time):
        self.times.append(time)

    def playing_is(self, playing):
        self.plays.append(playing)
