"""Malicious clients of a control socket, as a process; runs until stdin ends.

python crowd.py SOCKET ask|deaf|garbage COUNT

Prints the number of answers, and those that granted anything.
"""

from __future__ import annotations

import contextlib
import json
import random
import select
import socket
import sys
import time

CALL = json.dumps({"method": "org.rthyb.Control.GetStatus", "parameters": {}}).encode() + b"\0"
OPEN = b'{"method":"org.rthyb.Control.GetStatus","parameters":{"a":'
PAUSE_S = 0.02


def connected(path: str) -> socket.socket | None:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        made.connect(path)
    except OSError:
        made.close()
        return None
    made.setblocking(False)
    return made


def garbage(chance: random.Random) -> bytes:
    """Return invalid requests, or ones that are far too long or deep."""
    kind = chance.randrange(5)
    if kind == 0:
        return chance.randbytes(chance.randrange(1, 2000))
    if kind == 1:
        return OPEN + b"[" * 5000 + b"\0"
    if kind == 2:
        return OPEN + b'"' + b"x" * 100_000
    if kind == 3:
        wrong = {"method": "org.rthyb.Control.Start", "parameters": {"token": "0" * 32}}
        return json.dumps(wrong).encode() + b"\0"
    at = chance.randrange(len(CALL))
    return CALL[:at] + chance.randbytes(3) + CALL[at:]


class Crowd:
    """A number of connections, each re-established when the service has closed it."""

    def __init__(self, path: str, kind: str, count: int) -> None:
        self.path, self.kind = path, kind
        self.made: list[socket.socket | None] = [None] * count
        self.chance = random.Random(1024)
        self.sent = self.answers = 0
        self.granted: list[str] = []

    def turn(self) -> None:
        """Send something on every connection."""
        for i, one in enumerate(self.made):
            one = one or connected(self.path)
            self.made[i] = one
            if one is None:
                continue
            try:
                one.send(garbage(self.chance) if self.kind == "garbage" else CALL)
                self.sent += 1
                if self.kind != "deaf":
                    self.take(one.recv(1 << 20))
            except BlockingIOError:
                continue
            except OSError:
                one.close()
                self.made[i] = None

    def take(self, data: bytes) -> None:
        """Count answers; keep those that granted an invalid request."""
        if not data:
            raise ConnectionResetError
        for answer in filter(None, data.split(b"\0")):
            self.answers += 1
            if self.kind == "garbage" and b'"error"' not in answer:
                self.granted.append(answer[:100].decode(errors="replace"))


def main(path: str, kind: str, count: int) -> None:
    crowd = Crowd(path, kind, count)
    print("there", flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        crowd.turn()
        time.sleep(PAUSE_S)
    for one in crowd.made:
        with contextlib.suppress(AttributeError):
            one.close()  # type: ignore[union-attr]
    print(json.dumps({"sent": crowd.sent, "answers": crowd.answers, "granted": crowd.granted}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
