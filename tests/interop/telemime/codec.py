"""Encoding of §3: types that read and write values, limits that come before allocation, one encoding for each value."""

import math
import struct


class WireError(Exception):
    """Bytes that MUST be rejected; `name` is the reason's name in the table of §3."""

    def __init__(self, name, detail):
        super().__init__(f"{name}: {detail}")
        self.name = name


def out_of_range(what, value):
    return WireError("Invalid", f"{what} = {value!r}")


class Reader:
    """Bytes, a place in them, and what is left of the limit."""

    def __init__(self, data, limit):
        self.data, self.at, self.left = data, 0, limit

    def take(self, n):
        if self.at + n > len(self.data):
            raise WireError("Malformed", f"{n} bytes wanted, {len(self.data) - self.at} left")
        self.at += n
        return self.data[self.at - n : self.at]

    def claim(self, n):
        self.left -= n
        if self.left < 0:
            raise WireError("Malformed", "claims more than its limit")


class Kind:
    """A type: `read` takes it from a Reader, `write` appends it, `check` raises for what is outside the stated ranges."""

    def check(self, value):
        pass


class Unsigned(Kind):
    """u16, u32, u64: one byte below 251, else a marker and the shortest width that holds it."""

    def __init__(self, width):
        self.width, self.max = width, (1 << 8 * width) - 1

    def read(self, r):
        r.claim(self.width)
        n = r.take(1)[0]
        if n > 250:
            width = {251: 2, 252: 4, 253: 8}.get(n)
            if width is None or width > self.width:
                raise WireError("Malformed", f"integer marker {n:#x} in a field of {self.width} bytes")
            n = int.from_bytes(r.take(width), "little")
        return n

    def write(self, n, out):
        if not (isinstance(n, int) and 0 <= n <= self.max):
            raise out_of_range(f"u{8 * self.width}", n)
        if n < 251:
            out.append(n)
            return
        marker, width = next((m, w) for m, w in ((251, 2), (252, 4), (253, 8)) if n < 1 << 8 * w)
        out.append(marker)
        out += n.to_bytes(width, "little")


def zigzag(n):
    return 2 * n if n >= 0 else -2 * n - 1


def unzigzag(n):
    return n >> 1 if n & 1 == 0 else -(n >> 1) - 1


class Signed(Kind):
    """i16, i32, i64: zigzag, then as an unsigned integer."""

    def __init__(self, width):
        self.inner = Unsigned(width)

    def read(self, r):
        return unzigzag(self.inner.read(r))

    def write(self, n, out):
        self.inner.write(zigzag(n), out)


class Plain(Kind):
    """u8, i8, f32, f64: their own bytes."""

    def __init__(self, code):
        self.code, self.size = "<" + code, struct.calcsize("<" + code)

    def read(self, r):
        r.claim(self.size)
        return struct.unpack(self.code, r.take(self.size))[0]

    def write(self, value, out):
        try:
            out += struct.pack(self.code, value)
        except struct.error:
            raise out_of_range(self.code, value) from None


U8, I8, F32, F64 = Plain("B"), Plain("b"), Plain("f"), Plain("d")
U16, U32, U64 = Unsigned(2), Unsigned(4), Unsigned(8)
I16, I32, I64 = Signed(2), Signed(4), Signed(8)


class Array(Kind):
    """[T; n]: the elements."""

    def __init__(self, item, n):
        self.item, self.n = item, n

    def read(self, r):
        return [self.item.read(r) for _ in range(self.n)]

    def check(self, values):
        for value in values:
            self.item.check(value)

    def write(self, values, out):
        if len(values) != self.n:
            raise out_of_range("length", len(values))
        for value in values:
            self.item.write(value, out)


class Vec(Kind):
    """Vec<T>: the number of elements, at least `least` and at most `most`, then the elements."""

    def __init__(self, item, most=None, least=0):
        self.item, self.most, self.least = item, most, least

    def read(self, r):
        return [self.item.read(r) for _ in range(U64.read(r))]

    def check(self, values):
        if len(values) < self.least or (self.most is not None and len(values) > self.most):
            raise out_of_range("length", len(values))
        for value in values:
            self.item.check(value)

    def write(self, values, out):
        U64.write(len(values), out)
        for value in values:
            self.item.write(value, out)


class Bytes(Kind):
    """`bytes`: their number, at most `most`, and themselves."""

    def __init__(self, most):
        self.most = most

    def read(self, r):
        n = U64.read(r)
        r.claim(n)
        return bytes(r.take(n))

    def check(self, value):
        require(len(value) <= self.most, "length", len(value))

    def write(self, value, out):
        U64.write(len(value), out)
        out += value


class Text(Bytes):
    """String: UTF-8, `least` to `most` bytes."""

    def __init__(self, most, least=0):
        super().__init__(most)
        self.least = least

    def read(self, r):
        data = super().read(r)
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError as e:
            raise WireError("Malformed", f"not UTF-8: {e}") from None

    def check(self, value):
        require(self.least <= len(value.encode("utf-8")) <= self.most, "text", value)

    def write(self, value, out):
        super().write(value.encode("utf-8"), out)


class Option(Kind):
    """Option<T>: 00, or 01 and the value."""

    def __init__(self, item):
        self.item = item

    def read(self, r):
        tag = U8.read(r)
        if tag > 1:
            raise WireError("Malformed", f"option tag {tag}")
        return self.item.read(r) if tag else None

    def check(self, value):
        if value is not None:
            self.item.check(value)

    def write(self, value, out):
        out.append(0 if value is None else 1)
        if value is not None:
            self.item.write(value, out)


class Struct(Kind):
    """A structure: its fields in order; `check` looks at what they are together."""

    def __init__(self, *fields, check=None):
        self.fields, self.together = fields, check

    def read(self, r):
        return {name: kind.read(r) for name, kind in self.fields}

    def check(self, value):
        for name, kind in self.fields:
            kind.check(value[name])
        if self.together:
            self.together(value)

    def write(self, value, out):
        require(set(value) == {name for name, _ in self.fields}, "fields", sorted(value))
        for name, kind in self.fields:
            kind.write(value[name], out)


class Enum(Kind):
    """An enumeration: the variant's index, then its fields. A value is {name: fields}, or the name where there are none."""

    def __init__(self, *variants):
        self.variants = [v if isinstance(v, tuple) else (v, None) for v in variants]

    def read(self, r):
        i = U32.read(r)
        if i >= len(self.variants):
            raise WireError("Malformed", f"variant {i} of {len(self.variants)}")
        name, kind = self.variants[i]
        return name if kind is None else {name: kind.read(r)}

    def check(self, value):
        if not isinstance(value, str):
            name, fields = next(iter(value.items()))
            dict(self.variants)[name].check(fields)

    def write(self, value, out):
        name, fields = (value, None) if isinstance(value, str) else next(iter(value.items()))
        for i, (known, kind) in enumerate(self.variants):
            if known == name and (kind is None) == (fields is None):
                U32.write(i, out)
                if kind is not None:
                    kind.write(fields, out)
                return
        raise out_of_range("variant", name)


def encode(kind, value):
    """The one encoding of a value. Raises WireError for one outside its ranges."""
    kind.check(value)
    return _written(kind, value)


def _written(kind, value):
    out = bytearray()
    kind.write(value, out)
    return bytes(out)


def decode(kind, data, limit):
    """The value these bytes are the encoding of. Raises WireError."""
    if len(data) > limit:
        raise WireError("TooLong", f"{len(data)} bytes, at most {limit}")
    r = Reader(data, limit)
    value = kind.read(r)
    if r.at != len(data):
        raise WireError("Trailing", f"{len(data) - r.at} bytes left over")
    if _written(kind, value) != data:
        raise WireError("NotCanonical", "encodes differently")
    kind.check(value)
    return value


def finite(what, *values):
    """Raises unless all numbers, in lists or not, are finite."""
    for value in values:
        if isinstance(value, (list, tuple)):
            finite(what, *value)
        elif not math.isfinite(value):
            raise out_of_range(what, value)


def require(condition, what, value):
    """Raises Invalid unless the condition holds."""
    if not condition:
        raise out_of_range(what, value)


def round_away(x):
    """The nearest integer, halves away from zero."""
    a = abs(x)
    n = math.floor(a)
    n += a - n >= 0.5
    return n if x >= 0 else -n
