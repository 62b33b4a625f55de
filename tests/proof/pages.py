"""Pages of a live view that read every frame, as a process; runs until stdin ends.

python pages.py URL COUNT

Prints the number of messages, and their total length.
"""

from __future__ import annotations

import asyncio
import json
import sys
from urllib.parse import urlsplit

from websockets.asyncio.client import connect

VIEW = json.dumps({"view": {"follow": True, "seconds": 10, "columns": 1024}})


class Taken:
    """What the pages received.

    Attributes:
        messages, size: number of messages, and of bytes or characters.
    """

    def __init__(self) -> None:
        self.messages = self.size = 0


async def page(url: str, taken: Taken) -> None:
    """Follow the running test, like the page, and count what arrives."""
    address = urlsplit(url)
    origin = f"{address.scheme}://{address.netloc}"
    socket = f"ws://{address.netloc}{address.path}socket"
    async with connect(socket, origin=origin, max_size=None) as made:
        await made.send(VIEW)
        async for message in made:
            taken.messages += 1
            taken.size += len(message)


async def main(url: str, count: int) -> None:
    taken = Taken()
    pages = [asyncio.create_task(page(url, taken)) for _ in range(count)]
    while not taken.messages:
        await asyncio.sleep(0.1)
    print("there", flush=True)
    await asyncio.to_thread(sys.stdin.readline)
    print(json.dumps({"messages": taken.messages, "size": taken.size}), flush=True)
    for one in pages:
        one.cancel()
    await asyncio.gather(*pages, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
