"""Bit fields of navigation messages: one table serves the encoder and the decoder.

A message is a Python integer of `n_bits` bits; bit 1 is the first transmitted bit and the most significant
one, as in the ICDs. A table is a tuple of `Field`; bits that no field covers are zero.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from signals.constants import GNSS_PI, SECONDS_PER_WEEK


class Field(NamedTuple):
    """One field: its record name, its places, and how the integer on air becomes a number.

    `spans` are (first bit, number of bits) pairs, most significant part first. `kind` is "u" (unsigned) or
    "s" (two's complement). A field in semicircles becomes radians (times `GNSS_PI`). `exact` fields (times,
    indices) must be whole multiples of the scale. `cyclic` fields are angles modulo one turn. `top` is the
    largest integer allowed where the bits could hold more.
    """

    name: str
    spans: tuple[tuple[int, int], ...]
    kind: str = "u"
    scale: float = 1.0
    unit: str = ""
    exact: bool = False
    cyclic: bool = False
    top: int | None = None

    @property
    def lsb(self) -> float:
        """Weight of the last bit in the unit of the record."""
        return self.scale * (GNSS_PI if self.unit.startswith("semicircle") else 1.0)

    @property
    def n(self) -> int:
        """Number of bits."""
        return sum(n for _, n in self.spans)

    @property
    def limits(self) -> tuple[int, int]:
        """Smallest and largest integer that can be sent."""
        if self.kind == "s":
            return -(1 << (self.n - 1)), (1 << (self.n - 1)) - 1
        return 0, (1 << self.n) - 1 if self.top is None else self.top

    def quantise(self, value: float, where: str) -> int:
        """Integer that is sent for `value`; `where` opens the sentence of the ValueError."""
        low, high = self.limits
        if not np.isfinite(value):
            raise ValueError(f"{where}: {self.name} = {value} is not a finite number")
        raw = round(value / self.lsb)
        if self.exact and raw * self.lsb != value:
            raise ValueError(
                f"{where}: {self.name} = {value} must be a whole multiple of {self.lsb:g} {self.unit}"
            )
        if self.cyclic:
            raw = (raw - low) % (1 << self.n) + low
        if not low <= raw <= high:
            raise ValueError(
                f"{where}: {self.name} = {value} cannot be sent in {self.n} bits, "
                f"allowed {low * self.lsb:.9g} to {high * self.lsb:.9g}"
            )
        return raw


def integer(name: str, start: int, n: int, *, top: int | None = None) -> Field:
    """Unsigned integer of `n` bits from bit `start` on."""
    return Field(name, ((start, n),), exact=True, top=top)


def pack(table: tuple[Field, ...], values: Mapping, n_bits: int, where: str) -> int:
    """Message of `n_bits` bits that carries `values`; ValueError names the field that cannot be sent."""
    message = 0
    for field in table:
        raw = field.quantise(float(values[field.name]), where) & ((1 << field.n) - 1)
        left = field.n
        for start, n in field.spans:
            left -= n
            message |= ((raw >> left) & ((1 << n) - 1)) << (n_bits - start + 1 - n)
    return message


def unpack(table: tuple[Field, ...], message: int, n_bits: int) -> dict[str, float]:
    """Values of the fields of a message, in the units of the records (integers where the scale is 1)."""
    values: dict[str, float] = {}
    for field in table:
        raw = 0
        for start, n in field.spans:
            raw = (raw << n) | ((message >> (n_bits - start + 1 - n)) & ((1 << n) - 1))
        if field.kind == "s" and raw >> (field.n - 1):
            raw -= 1 << field.n
        values[field.name] = raw if field.lsb == 1.0 else raw * field.lsb
    return values


def check_start(where: str, week: int, tow_s: int, n: int) -> None:
    """Refuse a first week or second that cannot be, and a negative length."""
    if week != int(week) or week < 0:
        raise ValueError(f"{where}: week {week} must be a whole number of weeks since 1980-01-06")
    if tow_s != int(tow_s) or not 0 <= tow_s < SECONDS_PER_WEEK:
        raise ValueError(f"{where}: tow_s = {tow_s} must be a whole second from 0 to {SECONDS_PER_WEEK - 1}")
    if n < 0:
        raise ValueError(f"{where}: {n} symbols cannot be sent, ask for 0 or more")


def bits_of(message: int, n_bits: int) -> np.ndarray:
    """Bits of a message, first transmitted first, uint8 (n_bits,)."""
    return np.frombuffer(format(message, f"0{n_bits}b").encode(), np.uint8) - 48


def message_of(bits: np.ndarray) -> int:
    """Inverse of `bits_of`."""
    n = len(bits)
    packed = np.packbits(np.asarray(bits, np.uint8))
    return int.from_bytes(packed.tobytes(), "big") >> (-n % 8)
