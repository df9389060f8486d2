"""Data symbols of the channels to messages, and messages to transmit times."""

import numpy as np

from signals import inav, lnav
from signals.records import EPHEMERIS
from tracking.kernels import KIND_CA, KIND_PILOT
from tracking.lock import STATE_LOCKED

__all__ = ["Telemetry"]

_ORBIT = ("week", "toe_s", "sqrt_a_sqrt_m", "e", "m0_rad", "omega0_rad", "i0_rad", "af0_s")
_GAP = 2  # symbols, fewer than passed: a restarted channel must not continue the count of the one before


class Telemetry:
    """Feeds the symbols of a ``Tracker`` to one decoder per satellite; decoders outlive channels.

    Symbols of C/A are bits of 20 ms that begin at the synchronised code period; those of E1-B one per code.
    With the pilot in lock (CS25_1 upright) the composite eB(..) - eC(..) leaves E1-B inverted: the sign is
    restored, so that a symbol + is logic 0 (Galileo OS SIS ICD, 2.3.3). Other half-cycle ambiguities are the
    decoder's.

    Attributes
    ----------
    decoders : dict
        (system, prn) -> ``signals.lnav.Decoder`` or ``signals.inav.Decoder``, ("G", 7) for instance.
    """

    def __init__(self, tracker):
        self.tracker = tracker
        self.decoders = {}
        self._base = {}  # channel -> symbol index of its code period 0
        self._end = {}  # satellite -> next symbol index
        self._heard = []  # (symbols, counts) of the slabs that wait to be decoded
        self._slips = {}  # satellite -> (slips, transmit time of symbol 0) at the last call of slipped
        self._tail = {}  # Galileo satellite -> last nine symbol signs, while its pages are not synchronised
        self._asked = {}  # satellite -> symbol index from which on a message must say the time again
        self._matches = {}  # Galileo satellite -> [upright, inverted] sync patterns seen meanwhile

    def start(self, c):
        """Channel ``c`` was given to a satellite (again): its code periods count from zero."""
        key = self._satellite(c)
        if key not in self.decoders:
            self.decoders[key] = lnav.Decoder(key[1]) if key[0] == "G" else inav.Decoder(key[1])
        self._base[c] = self._end.get(key, 0) + _GAP
        self._slips.pop(key, None)

    def update(self):
        """Decode what the last ``Tracker.process`` brought -> list of (channel, event) of the decoders."""
        self.hear()
        return self.decode()

    def hear(self):
        """Keep the symbols of the last ``Tracker.process`` until ``decode``: a few slabs together cost little more."""
        self._heard.append((self.tracker.symbols, self.tracker.symbol_counts))

    def decode(self):
        """Decode what was heard, before a channel changes hands at the latest -> list of (channel, event)."""
        heard, self._heard = [(symbols, counts.tolist()) for symbols, counts in self._heard], []
        events = []
        for c in range(max((len(counts) for _, counts in heard), default=0)):
            parts = [symbols[c, : counts[c]] for symbols, counts in heard if c < len(counts) and counts[c]]
            if not parts:
                continue
            if c not in self._base:
                self.start(c)
            index = self._index(c, np.concatenate([rows["code_period"] for rows in parts]))
            sign = np.float32(-1.0 if self.tracker.channels["kind"][c] == KIND_PILOT else 1.0)
            soft = sign * np.concatenate([rows["soft"] for rows in parts])
            events += [(c, e) for e in self._feed(self._satellite(c), index, soft)]
        return events

    def _feed(self, key, index, symbols):
        """Feed the runs between holes: a bit that was cut off leaves one in the count."""
        decoder, events = self.decoders[key], []
        ends = [*(np.flatnonzero(np.diff(index) != 1) + 1).tolist(), len(index)]
        for first, end in zip([0, *ends], ends):
            events += decoder.feed(symbols[first:end], int(index[first]))
            if key[0] == "E" and not decoder.synced:
                self._look_for_sync(key, symbols[first:end])
        self._end[key] = int(index[-1]) + 1
        return events

    def _look_for_sync(self, key, symbols):
        """Count exact sync patterns of either sign (by chance, 2 in 1024 places) until a page confirms one."""
        signs = np.concatenate([self._tail.get(key, np.zeros(0)), np.sign(symbols)])
        score = np.correlate(signs, inav.SYNC_SIGNS, "valid") if len(signs) >= 10 else np.zeros(0)
        matches = self._matches.setdefault(key, [0, 0])
        matches[0] += int(np.sum(score > 9.5))
        matches[1] += int(np.sum(score < -9.5))
        self._tail[key] = signs[-9:]

    def sync_patterns(self, signal, prn):
        """(upright, inverted) I/NAV sync patterns seen before page synchronisation; None for GPS."""
        key = _system(signal), int(prn)
        return tuple(self._matches.get(key, (0, 0))) if key[0] == "E" else None

    def reference(self, c):
        """(code period, transmit time of week at its start in ms) of channel ``c``; (0, -1) while not
        decoded.
        """
        st = self.tracker.channels[c]
        key = self._satellite(c)
        if c not in self._base or key not in self._end or st["state"] != STATE_LOCKED:
            return 0, -1
        tow_ms = self.decoders[key].tow_of(self._end[key])
        if tow_ms is None:
            return 0, -1
        return self._period(c, self._end[key]), int(tow_ms)

    def transmit_time_ms(self, c, code_period):
        """Transmit time of week (ms) of the start of ``code_period`` of channel ``c``; None while not
        decoded.
        """
        period, tow_ms = self.reference(c)
        if tow_ms < 0:
            return None
        step = 1 if self.tracker.channels["kind"][c] == KIND_CA else 4
        return (tow_ms + (int(code_period) - period) * step) % 604_800_000

    def stamp(self, epochs, counts):
        """Write ``tow_s`` into EPOCH rows of ``Tracker.process`` (C, n_max) where it is known."""
        for c in np.flatnonzero(counts):
            period, tow_ms = self.reference(int(c))
            if tow_ms >= 0:
                step = 1e-3 if self.tracker.channels["kind"][c] == KIND_CA else 4e-3
                rows = epochs[c, : counts[c]]
                tow_s = tow_ms * 1e-3 + (rows["symbol_index"] - period) * step
                # The integration starts up to one sample after the code does: code_phase_chips tells how
                # much.
                rows["tow_s"] = (tow_s + rows["code_phase_chips"] / 1.023e6) % 604_800.0

    def slipped(self, channels, slips):
        """Whether each channel slipped a cycle, or its time moved, since the last call; a channel not asked before did."""
        out = np.zeros(len(channels), bool)
        for k, c in enumerate(channels):
            key = self._satellite(int(c))
            now = int(slips[k]), self.decoders[key].tow_of(0) if key in self.decoders else None
            out[k] = self._slips.get(key) != now
            self._slips[key] = now
        return out

    def doubt(self):
        """Samples may be missing up to here: no transmit time is sure until a message says it again."""
        self._asked = dict(self._end)

    def doubted(self):
        """Satellites whose messages have not said the time since ``doubt`` -> frozenset of (b"G" or b"E", prn)."""
        for key in [k for k, asked in self._asked.items() if self.decoders[k].timed_index >= asked]:
            del self._asked[key]
        return frozenset((system.encode(), prn) for system, prn in self._asked)

    def ephemerides(self):
        """Newest decoded ephemeris of each satellite -> EPHEMERIS (n,)."""
        rows = [d.ephemeris for d in self.decoders.values() if d.ephemeris is not None]
        return np.array(rows, EPHEMERIS) if rows else np.zeros(0, EPHEMERIS)

    def shared_orbits(self):
        """Groups of GPS satellites that sent one and the same ephemeris -> list of lists of (system, prn).

        LNAV does not say whose it is: all but one of a group are another's signal, found through the cross-correlation
        of the codes. I/NAV names its satellite, and the decoder minds it.
        """
        groups: dict = {}
        for key, d in self.decoders.items():
            if key[0] == "G" and d.ephemeris is not None:
                groups.setdefault(tuple(d.ephemeris[list(_ORBIT)].item()), []).append(key)
        return [keys for keys in groups.values() if len(keys) > 1]

    def forget(self, system, prn):
        """What the channels of this satellite said was not its own."""
        self.decoders.pop((system, prn), None)
        self._asked.pop((system, prn), None)
        for c in [c for c in self._base if self._satellite(c) == (system, prn)]:
            del self._base[c]
            for _, counts in self._heard:
                counts[c : c + 1] = 0

    def iono_utc(self, system):
        """IONO_UTC record of the most complete decoder of ``system`` ("G" or "E"); None before anything came."""
        best = None
        for (s, _), d in self.decoders.items():
            if (
                s == system
                and d.iono_utc_valid
                and (best is None or len(d.iono_utc_valid) > len(best.iono_utc_valid))
            ):
                best = d
        return None if best is None else best.iono_utc

    def has_ephemeris(self, signal, prn):
        """Whether a complete ephemeris of the satellite was decoded."""
        d = self.decoders.get((_system(signal), int(prn)))
        return d is not None and d.ephemeris is not None

    def healthy(self, signal, prn):
        """The satellite's health; None while not decoded."""
        d = self.decoders.get((_system(signal), int(prn)))
        return None if d is None else d.healthy

    def _satellite(self, c):
        st = self.tracker.channels[c]
        return _system(st["signal"]), int(st["prn"])

    def _index(self, c, code_period):
        """Running symbol index of the symbol that starts at ``code_period``."""
        st = self.tracker.channels[c]
        if st["kind"] == KIND_CA:
            return self._base[c] + (np.asarray(code_period) - st["symbol_phase"]) // 20
        return self._base[c] + np.asarray(code_period)

    def _period(self, c, index):
        """Code period at which symbol ``index`` starts."""
        st = self.tracker.channels[c]
        if st["kind"] == KIND_CA:
            return int((index - self._base[c]) * 20 + st["symbol_phase"])
        return int(index - self._base[c])


def _system(signal):
    text = signal.decode() if isinstance(signal, bytes) else str(np.asarray(signal).astype("U4"))
    return "G" if text == "L1CA" else "E"
