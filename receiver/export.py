"""``telepose-receive export``: the person that a running receiver shows now, as files."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import aclosing
from pathlib import Path

from receiver.viewer.page_client import PageError, follow
from receiver.viewer.page_view import PagePerson
from receiver.viewer.person_files import ExportError, write_person


def export(page: str, files: Sequence[Path], wait_s: float) -> None:
    """Write the person shown at ``page`` to all ``files``, waiting ``wait_s`` for one to appear.

    Raises:
        ExportError: no receiver, nobody to be seen, or a file that cannot be written.
    """
    for file in files:
        if not file.parent.is_dir():
            raise ExportError(f"cannot write {file}: there is no folder {file.parent}")
    try:
        person = asyncio.run(_person_at(page, wait_s))
    except PageError as error:
        raise ExportError(str(error)) from error
    except TimeoutError as error:
        raise ExportError(f"{page} showed nobody for {wait_s:g} s") from error
    for file in files:
        write_person(file, person)


async def _person_at(page: str, wait_s: float) -> PagePerson:
    async with asyncio.timeout(wait_s):
        async with aclosing(follow(page)) as views:
            async for view in views:
                if view.person is not None:
                    return view.person
    raise PageError(f"{page} closed the connection before anybody was seen")
