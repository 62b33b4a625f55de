"""The kernel's network interfaces, read over rtnetlink."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from rthyb_rt.errors import InputError

ARPHRD_CAN: Final = 280
IFF_UP: Final = 1
BITRATE_UNKNOWN: Final = 2**32 - 1
"""Bit rate reported by the kernel's slcan driver if another program chose it."""


@dataclass(frozen=True)
class NetworkInterface:
    """A network interface; ``None`` for what the kernel does not report.

    Attributes:
        name: as in ``ip link``.
        is_can: whether it carries CAN frames.
        driver: "can" for hardware and slcan, "vcan", "vxcan"; "" if not reported.
        up: whether it is switched on.
        operational: the kernel's name of its state ("UP", "DOWN", "UNKNOWN").
        mtu: bytes of the largest frame: 16 for CAN, 72 for CAN FD.
        bitrate, data_bitrate: bit/s, of arbitration and of CAN FD's data.
        restart_ms: time after which the kernel restarts the controller after a bus-off; 0: never.
        state: of the CAN controller: "ERROR_ACTIVE", "ERROR_WARNING", "ERROR_PASSIVE", "BUS_OFF",
            "STOPPED", "SLEEPING".
        listen_only: whether it receives but never sends.
    """

    name: str
    is_can: bool
    driver: str
    up: bool
    operational: str
    mtu: int
    bitrate: int | None = None
    data_bitrate: int | None = None
    restart_ms: int | None = None
    state: str | None = None
    listen_only: bool = False


def interfaces() -> dict[str, NetworkInterface]:
    """Return every network interface by name.

    Raises:
        InputError: the kernel does not answer.
    """
    from pyroute2 import IPRoute  # slow to import, and only needed for SocketCAN

    try:
        with IPRoute() as kernel:
            return by_name(kernel.get_links())
    except OSError as error:
        raise InputError(
            f"the kernel does not list its network interfaces: {error.strerror or error}; if a "
            "sandbox forbids it, allow AF_NETLINK (systemd: RestrictAddressFamilies=)",
            "rtnetlink",
        ) from error


def by_name(links: Iterable[Any]) -> dict[str, NetworkInterface]:
    """Return interfaces by name, from the kernel's messages as pyroute2 decodes them."""
    return {found.name: found for found in map(_interface, links)}


def _interface(link: Any) -> NetworkInterface:
    info = link.get_attr("IFLA_LINKINFO")
    driver = info.get_attr("IFLA_INFO_KIND") if info else None
    data = info.get_attr("IFLA_INFO_DATA") if info and driver == "can" else None
    return NetworkInterface(
        name=str(link.get_attr("IFLA_IFNAME")),
        is_can=link["ifi_type"] == ARPHRD_CAN,
        driver=driver or "",
        up=bool(link["flags"] & IFF_UP),
        operational=str(link.get_attr("IFLA_OPERSTATE") or "UNKNOWN"),
        mtu=int(link.get_attr("IFLA_MTU") or 0),
        **(_controller(data) if data else {}),
    )


def _controller(data: Any) -> dict[str, Any]:
    state = data.get_attr("IFLA_CAN_STATE")
    mode = data.get_attr("IFLA_CAN_CTRLMODE") or {}
    return {
        "bitrate": _bitrate(data.get_attr("IFLA_CAN_BITTIMING")),
        "data_bitrate": _bitrate(data.get_attr("IFLA_CAN_DATA_BITTIMING")),
        "restart_ms": data.get_attr("IFLA_CAN_RESTART_MS"),
        "state": None if state is None else str(state),
        "listen_only": mode.get("listenonly") == "on",
    }


def _bitrate(timing: Any) -> int | None:
    if not timing or timing["bitrate"] in (0, BITRATE_UNKNOWN):
        return None
    return int(timing["bitrate"])
