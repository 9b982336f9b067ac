"""The numbers of a blackbox log: few bits for small ones, in one of eight encodings.

Reference: the description of the format by Nicholas Sherlock ("Blackbox internals", Cleanflight), and the sources of
Betaflight and INAV for the encodings that came later.
"""

_SIGNED, _UNSIGNED, _NEGATIVE_14, _TAG8, _TAG2_3, TAG8_4, _NULL, _TAG2_3_VARIABLE = 0, 1, 3, 6, 7, 8, 9, 10
TOGETHER = {_SIGNED: 512, _UNSIGNED: 512, _NEGATIVE_14: 512, _NULL: 512} | {
    **{_TAG8: 8, _TAG2_3: 3, TAG8_4: 4, _TAG2_3_VARIABLE: 3},
}
"""The encodings that are known, and how many fields of each are read together."""


class Numbers:
    """Reads numbers from `data`. `at`: the number of bytes read. Raises `IndexError` at the end of the data."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def read(self, encoding: int, count: int, values: list[int]) -> None:
        """Append `count` numbers of one encoding."""
        if encoding == _SIGNED or (encoding == _TAG8 and count == 1):
            self.signed(count, values)
        elif encoding == _UNSIGNED:
            self.unsigned(count, values)
        elif encoding == _NULL:
            values += [0] * count
        else:
            values += _GROUPS[encoding](self, count)[:count]

    def byte(self) -> int:
        """The next byte."""
        self.at += 1
        return self.data[self.at - 1]

    def unsigned(self, count: int, values: list[int]) -> None:
        """Seven bits a byte, the lowest first; the eighth says that another byte follows."""
        data, at = self.data, self.at
        for _ in range(count):
            byte = data[at]
            at += 1
            value, shift = byte & 0x7F, 7
            while byte & 0x80 and shift < 35:
                byte = data[at]
                at += 1
                value |= (byte & 0x7F) << shift
                shift += 7
            values.append(value)
        self.at = at

    def signed(self, count: int, values: list[int]) -> None:
        """The same, with the sign in the lowest bit."""
        begin = len(values)
        self.unsigned(count, values)
        for i in range(begin, len(values)):
            values[i] = (values[i] >> 1) ^ -(values[i] & 1)

    def _negative_14(self, count: int) -> list[int]:
        values: list[int] = []
        self.unsigned(count, values)
        return [-_extended(value, 14) for value in values]

    def _tag8(self, count: int) -> list[int]:
        """A byte says which of up to eight numbers are not 0."""
        header, values = self.byte(), []
        for i in range(count):
            if header >> i & 1:
                self.signed(1, values)
            else:
                values.append(0)
        return values

    def _tag2_3(self, _: int) -> list[int]:
        """Three numbers of 2, 4 or 6 bits, or of whole bytes."""
        lead = self.byte()
        width = lead >> 6
        if width == 0:
            return [_extended(lead >> shift, 2) for shift in (4, 2, 0)]
        if width == 1:
            second = self.byte()
            return [_extended(value, 4) for value in (lead, second >> 4, second)]
        if width == 2:
            return [_extended(value, 6) for value in (lead, self.byte(), self.byte())]
        return self._of_bytes(lead)

    def _tag2_3_variable(self, _: int) -> list[int]:
        """Three numbers of 2, of 5, 5, 4, or of 8, 7, 7 bits, or of whole bytes."""
        lead = self.byte()
        width = lead >> 6
        if width == 0:
            return [_extended(lead >> shift, 2) for shift in (4, 2, 0)]
        if width == 3:
            return self._of_bytes(lead)
        bits = lead & 0x3F
        for _ in range(width):
            bits = bits << 8 | self.byte()
        if width == 1:
            return [_extended(bits >> 9, 5), _extended(bits >> 4, 5), _extended(bits, 4)]
        return [_extended(bits >> 14, 8), _extended(bits >> 7, 7), _extended(bits, 7)]

    def _of_bytes(self, lead: int) -> list[int]:
        """Three numbers of one to four bytes each, the lowest byte first."""
        values = []
        for shift in (0, 2, 4):
            length = (lead >> shift & 3) + 1
            values.append(_extended(int.from_bytes(self._bytes(length), "little"), 8 * length))
        return values

    def _bytes(self, length: int) -> bytes:
        self.at += length
        if self.at > len(self.data):
            raise IndexError
        return self.data[self.at - length : self.at]

    def _tag8_4(self, _: int) -> list[int]:
        """Four numbers of 0, 4, 8 or 16 bits, in a row of half bytes."""
        header, values = self.byte(), []
        bits = held = 0
        for i in range(4):
            width = (0, 4, 8, 16)[header >> 2 * i & 3]
            while held < width:
                bits, held = bits << 8 | self.byte(), held + 8
            held -= width
            values.append(_extended(bits >> held, width) if width else 0)
            bits &= (1 << held) - 1
        return values


_GROUPS = {
    _NEGATIVE_14: Numbers._negative_14,
    _TAG8: Numbers._tag8,
    _TAG2_3: Numbers._tag2_3,
    TAG8_4: Numbers._tag8_4,
    _TAG2_3_VARIABLE: Numbers._tag2_3_variable,
}


def _extended(value: int, bits: int) -> int:
    """The lowest `bits` as a signed number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value
