"""Stand-ins: a viewer without a method, a page without a browser, coarse trials that fit nothing."""

from types import SimpleNamespace

import torch

from forewarp.viewer.queue import Cancelled, RenderQueue
from tests.support.tiny_scene import ball_scene

CANVAS = 640, 480


class Watch:
    """A clock that stands unless it is moved on."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


class FakeViewer:
    """Renders grey images; each takes ``cost`` seconds a pixel, of a clock that stands otherwise."""

    rows, aspect, note, can_follow, film, seconds = 400, 1.0, "", True, None, 4.0

    def __init__(self, watch=None, cost=0.0):
        self.watch, self.cost, self.scene = watch or Watch(), cost, ball_scene(frames=4)
        self.queue, self.interrupt = RenderQueue(self.watch), None
        method = SimpleNamespace(ellipsoids=lambda time: f"splats at {time}")
        self.renderers = [SimpleNamespace(method_of=lambda layer: method)]

    def supported(self, state):
        return state

    def prepare(self, state):
        self.watch.now += 0.001

    def image(self, state, width, height, chunks=1):
        self.watch.now += self.cost * width * height
        if self.interrupt:
            self.interrupt()
            if self.queue.is_stale():
                raise Cancelled
        return torch.full((height, width, 3), state.time)

    def beyond(self, state):
        return 0.0

    def point_at(self, state, x, y, width, height):
        return None if x > 0.9 else (x, y, 0.0)


class FakePage:
    """Keeps what it is shown and told."""

    def __init__(self):
        self.images, self.said, self.times, self.plays = [], [], [], []
        self.gone = 0

    def canvas(self):
        return CANVAS

    def show_image(self, image, *, rest):
        self.images.append((tuple(image.shape[:2]), rest, round(float(image[0, 0, 0]), 3)))

    def let_go(self):
        self.gone += 1

    def show_splats(self, ellipsoids):
        self.images.append(ellipsoids)

    def tell(self, text):
        self.said.append(text)

    def show_time(self, time):
        self.times.append(time)

    def show_playing(self, playing):
        self.plays.append(playing)
