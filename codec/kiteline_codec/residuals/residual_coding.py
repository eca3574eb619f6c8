"""Residual codes: shorter forms of codes on the wire. What is shared stays the code; see SPEC.md, "Residual codes".

A residual code is predicted from values that the peer is known to hold. It ends with a checksum of the code and of the
versions used; a receiver that holds others refuses it, and the sender then sends the code itself.
"""

from collections import OrderedDict
from collections.abc import Sequence
from struct import pack
from zlib import crc32

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.residuals.landmark_residuals import CHECKSUM_BYTES, NewLandmarkResiduals, RefinedLandmarkResiduals
from kiteline_codec.residuals.observation_residuals import ObservationResiduals
from kiteline_codec.residuals.predictors import Held, Predictors
from kiteline_codec.schema import Key, NewLandmarks, Observations, RefinedLandmarks
from kiteline_core.errors import INPUT_FAULTS

_Coder = NewLandmarkResiduals | ObservationResiduals | RefinedLandmarkResiduals

_CACHED = 64  # residual codes kept of new landmarks, which are asked for again until they fit a packet


class ResidualCoder:
    """Makes and reads residual codes, with a cache of decoded predictors."""

    def __init__(self) -> None:
        self._predictors = predictors = Predictors()
        self._coders: dict[int, _Coder] = {
            NewLandmarks.KIND: NewLandmarkResiduals(),
            Observations.KIND: ObservationResiduals(predictors),
            RefinedLandmarks.KIND: RefinedLandmarkResiduals(predictors),
        }
        self._new_landmarks: OrderedDict[Key, tuple[bytes, bytes | None]] = OrderedDict()  # codes, residual codes

    def restart(self) -> None:
        """Drop the decoded predictors: a new session of the peer numbers its values anew."""
        self._predictors.clear()

    def compress(self, key: Key, code: bytes, held: Held, own: Held) -> bytes | None:
        """The residual code of a code, for a peer that holds what `held` gives; None where it would not be shorter.

        own: values of this side, whether the peer holds them or not.
        """
        coder = self._coders.get(key.kind)
        if coder is None:
            return None
        if key.kind != NewLandmarks.KIND:
            return _compress(coder, key, code, held, own)
        cached = self._new_landmarks.get(key)
        if cached is None or cached[0] != code:
            cached = self._new_landmarks[key] = code, _compress(coder, key, code, held, own)
            if len(self._new_landmarks) > _CACHED:
                self._new_landmarks.popitem(last=False)
        return cached[1]

    def expand(self, key: Key, data: bytes, held: Held) -> bytes:
        """The code of a residual code. Raises WireError, also when its predictors are not held."""
        coder = self._coders.get(key.kind)
        if coder is None:
            raise WireError(f"kind {key.kind} has no residual code")
        source, out = Reader(data), Writer()
        try:
            versions = coder.expand(out, key, source, held)
            checksum, code = source.raw(CHECKSUM_BYTES), out.bytes()
            expected = _checksum(code, versions)
        except INPUT_FAULTS as error:
            raise WireError(f"the residual code of {key} cannot be read ({error!r})") from error
        source.end()
        if expected != checksum:
            raise WireError("a residual code was made with other values than are held")
        return code


def _compress(coder: _Coder, key: Key, code: bytes, held: Held, own: Held) -> bytes | None:
    out = Writer()
    try:
        versions = coder.compress(out, key, code, held, own)
    except (ValueError, WireError):  # a code of another schema, or numbers beyond the residual code: send it as it is
        return None
    data = out.bytes() + _checksum(code, versions)
    return data if len(data) < len(code) else None


def _checksum(code: bytes, versions: Sequence[int]) -> bytes:
    return crc32(pack(f"<{len(versions)}q", *versions), crc32(code)).to_bytes(CHECKSUM_BYTES, "little")
