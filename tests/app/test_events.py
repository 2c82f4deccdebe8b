"""Tabs hear of each other's edits, of other programs' edits, and of the server's end."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

from app.api.events import _stream
from app.context import Context
from app.events import Hub
from core.locks import take_lock
from core.project import read_project, write_project


def parsed(text: str) -> tuple[str, Any]:
    event, data = text.strip().split("\n")
    return event.removeprefix("event: "), json.loads(data.removeprefix("data: "))


def test_a_tab_is_greeted_and_hears_of_edits_by_others(context: Context, workspace: Path) -> None:
    folder = context.workspace.open("small")

    async def listen() -> list[tuple[str, Any]]:
        stream = _stream(context, folder)
        heard = [parsed(await anext(stream))]
        context.hub.publish("small", "inputs", {"kind": "lens"})
        context.hub.publish("other", "inputs", {"kind": "video"})
        heard.append(parsed(await anext(stream)))
        project = read_project(folder.folder)
        write_project(folder.folder, project.model_copy(update={"name": "by hand"}))
        heard.append(parsed(await asyncio.wait_for(anext(stream), 10)))
        await stream.aclose()  # type: ignore[attr-defined]
        return heard

    hello, inputs, edited = asyncio.run(listen())
    assert (hello[0], hello[1]["job"]) == ("hello", None)
    assert inputs == ("inputs", {"kind": "lens"})
    assert edited[0] == "project"
    assert edited[1]["revision"] > hello[1]["revision"]
    assert edited[1]["label"] == "changed outside"


def test_every_stream_ends_with_the_server() -> None:
    async def listen() -> list[str]:
        hub = Hub()
        with hub.listen("small") as listener:
            hub.publish("small", "scene", {})
            hub.close()
            return [message async for message in listener.messages(pause_s=5.0)]

    assert len(asyncio.run(asyncio.wait_for(listen(), 5))) <= 1


def test_a_tab_that_does_not_listen_costs_no_memory() -> None:
    async def listen() -> list[str]:
        hub = Hub()
        with hub.listen("small") as listener:
            for number in range(3000):
                hub.publish("small", "track", {"rows": [number]})
            return [message async for message in listener.messages(pause_s=0.2)]

    # Its stream is ended, so that the browser connects anew and loads the state as a whole.
    assert len(asyncio.run(asyncio.wait_for(listen(), 10))) < 1100


def test_one_server_at_a_time_is_in_charge_of_a_workspace(tmp_path: Path) -> None:
    first = take_lock(tmp_path)
    assert first is not None
    assert take_lock(tmp_path) is None
    first.close()
    second = take_lock(tmp_path)
    assert second is not None
    second.close()
