"""A page's controls, by viser."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import viser

from forewarp.viewer.film import LONGEST, SHORTEST
from forewarp.viewer.frusta import Frusta
from forewarp.viewer.look import SPLATS

if TYPE_CHECKING:
    from forewarp.viewer.page import Page

_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


class Controls:
    """What a person changes on a page. Each is made once, and shown where the methods can do it.

    Args:
        page: whose controls they are; methods that say what can be shown are there.
    """

    def __init__(self, page: Page) -> None:
        self.page, self.studio, self.client, self.visit = page, page.studio, page.client, page.visit
        self._showing, self._offered = threading.Lock(), None
        self._frusta = Frusta(self.client, self.studio, page.stand)
        if len(self.studio.subjects) == 2:
            left, right = (subject.name for subject in self.studio.subjects)
            self.client.gui.add_markdown(f"left: **{left}**, right: **{right}**")
        self._add_time()
        self._add_show()
        self._add_cameras()
        self._add_film()
        self.adapt()

    def adapt(self) -> None:
        """Offer what the present methods can show; a later stage of a run may have another one."""
        shows, follows = self.studio.shows, self.studio.follows
        if self._offered == (shows, follows):
            return
        self._offered = shows, follows
        self.what.options = shows  # viser chooses the first where the chosen one is gone, as ``known`` does
        self.splats.visible = SPLATS in shows
        for control in (self.tails, self.choose, self.forget):
            control.visible = follows
        if not follows:
            self.tails.value = False

    def stands(self) -> None:
        """Show the controls that go with where the page stands."""
        stands = self.visit.look.stand is not None
        if self.leave.visible != stands:
            self.leave.visible = stands
            self._show_frusta()

    def playing_is(self, playing: bool) -> None:
        """Name what the button does next."""
        self.play.label = "pause" if playing else "play"

    def _add_time(self) -> None:
        gui, visit = self.client.gui, self.visit
        with gui.add_folder("Time"):
            self.time = gui.add_slider("time", 0.0, 1.0, 0.001, round(visit.look.time, 3))
            self.play = gui.add_button("play")
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
            loop = gui.add_checkbox("loop", True)

        @self.time.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not our own, while time plays
                visit.change(time=float(self.time.value))
                self.stands()

        @self.play.on_click
        async def _(_: viser.GuiEvent) -> None:
            visit.play(not visit.player.playing)
            self.stands()
            self.playing_is(visit.player.playing)

        @speed.on_update
        async def _(_: viser.GuiEvent) -> None:
            visit.set_speed(float(speed.value))

        @loop.on_update
        async def _(_: viser.GuiEvent) -> None:
            visit.player.loop = loop.value

    def _add_show(self) -> None:
        gui, visit = self.client.gui, self.visit
        with gui.add_folder("Show"):
            self.what = gui.add_dropdown("show", self.studio.shows, initial_value=visit.look.show)
            self.splats = gui.add_markdown(
                "*splats*: drawn by the browser, with one colour from all sides and no trajectories"
            )
            self.tails = gui.add_checkbox("trajectories", False)
            self._add_following()
            picture = gui.add_button("screenshot")

        @self.what.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                visit.change(show=self.what.value)
                self.stands()

        @self.tails.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                visit.change(tails=self.tails.value)

        @picture.on_click
        def _(_: viser.GuiEvent) -> None:  # in a thread of its own, as it waits
            self.page.save_screenshot()

    def _add_following(self) -> None:
        gui, visit, scene = self.client.gui, self.visit, self.client.scene
        choose = self.choose = gui.add_button("follow the point that I click")
        forget = self.forget = gui.add_button("follow none")

        async def clicked(event: viser.SceneClickEvent) -> None:
            scene.remove_click_callback(clicked)
            choose.label = "follow the point that I click"
            visit.follow(*event.screen_pos)

        @choose.on_click
        async def _(_: viser.GuiEvent) -> None:
            scene.remove_click_callback("all")
            scene.on_click()(clicked)
            choose.label = "now click a point"

        @forget.on_click
        async def _(_: viser.GuiEvent) -> None:
            visit.change(followed=())

    def _add_cameras(self) -> None:
        gui, last = self.client.gui, len(self.studio.scene.train) - 1
        with gui.add_folder("Training images"):
            gui.add_markdown("Choose one, or click its camera, for truth | prediction | error.")
            self.image = gui.add_slider("image", 0, max(last, 1), 1, 0)
            # Over two pictures beside each other there is no one place for a camera.
            self.shown = gui.add_checkbox("show cameras", False, visible=len(self.studio.subjects) == 1)
            there = gui.add_button("go there")
            self.leave = gui.add_button("leave it", visible=False)

        @self.shown.on_update
        def _(_: viser.GuiEvent) -> None:  # in a thread of its own, as they are many
            self._show_frusta()

        @self.image.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self.page.stand(int(self.image.value))

        @there.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.page.stand(int(self.image.value))

        @self.leave.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.page.stand(None)

    def _add_film(self) -> None:
        gui, visit, keys = self.client.gui, self.visit, []
        with gui.add_folder("Video", expand_by_default=False):
            count = gui.add_markdown("0 key views")
            add, clear = gui.add_button("add this view and time"), gui.add_button("clear")
            seconds = gui.add_number("seconds", 4.0, min=SHORTEST, max=LONGEST, step=0.5)
            make = gui.add_button("make the video")

        def say(text: str | None = None) -> None:
            count.content = text or f"{len(keys)} key views"

        @add.on_click
        async def _(_: viser.GuiEvent) -> None:
            keys.append(visit.look)
            say()

        @clear.on_click
        async def _(_: viser.GuiEvent) -> None:
            keys.clear()
            say()

        @make.on_click
        def _(_: viser.GuiEvent) -> None:  # in a thread of its own, as it waits
            make.disabled = True
            try:
                self.page.save_film(list(keys), float(seconds.value), say)
            finally:
                make.disabled = False

    def _show_frusta(self) -> None:
        with self._showing:  # threads of the server may come at once
            self._frusta.show(self.shown.value and self.visit.look.stand is None)
