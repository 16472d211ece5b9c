"""Bits, highest first, and exponential Golomb codes (§9)."""

from .codec import WireError, unzigzag, zigzag


class BitReader:
    def __init__(self, data):
        self.data, self.at = data, 0

    def bits(self, n):
        value = 0
        for _ in range(n):
            if self.at == 8 * len(self.data):
                raise WireError("Malformed", "bits wanted after the end")
            value = value << 1 | self.data[self.at // 8] >> 7 - self.at % 8 & 1
            self.at += 1
        return value

    def golomb(self, k):
        zeros = 0
        while not self.bits(1):
            zeros += 1
            if zeros > 40:
                raise WireError("Malformed", "a number beyond 2^40")
        q = 1 << zeros | self.bits(zeros)
        n = q - 1 << k | self.bits(k)
        if n >= 1 << 40:
            raise WireError("Malformed", "a number beyond 2^40")
        return n

    def signed(self, k):
        return unzigzag(self.golomb(k))

    def end(self):
        """Raises unless only the zeros are left that fill the last byte."""
        if self.at + 7 < 8 * len(self.data) or self.bits(8 * len(self.data) - self.at):
            raise WireError("Malformed", "bits left over")


class BitWriter:
    def __init__(self):
        self.value, self.n = 0, 0

    def bits(self, value, n):
        self.value, self.n = self.value << n | value, self.n + n

    def golomb(self, n, k):
        q = (n >> k) + 1
        self.bits(q, 2 * q.bit_length() - 1)
        self.bits(n & (1 << k) - 1, k)

    def signed(self, n, k):
        self.golomb(zigzag(n), k)

    def bytes(self):
        fill = -self.n % 8
        return (self.value << fill).to_bytes((self.n + fill) // 8, "big")
