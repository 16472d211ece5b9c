//! Integers as bits: exponential Golomb codes, which spend few bits on small numbers and need no table.
//!
//! The code of order k writes n as the quotient q = ⌊n/2ᵏ⌋ + 1 in Elias' γ (one zero for each bit of q
//! after its first, then q, highest bit first) and then the k low bits of n: 2⌊log₂ q⌋ + 1 + k bits.

/// Numbers are below 2⁴⁰: more than the difference of any two coordinates or times on a grid.
const MAX_BITS: u32 = 40;

/// The largest order a column may have.
pub(crate) const MAX_ORDER: u32 = 31;

/// Bits, highest first within a byte.
#[derive(Clone, Debug, Default)]
pub(crate) struct BitWriter {
    bytes: Vec<u8>,
    used: u32,
}

impl BitWriter {
    /// The low `count` bits of `value`.
    pub(crate) fn put(&mut self, value: u64, count: u32) {
        for i in (0..count).rev() {
            if self.used == 0 {
                self.bytes.push(0);
                self.used = 8;
            }
            self.used -= 1;
            if value >> i & 1 == 1
                && let Some(last) = self.bytes.last_mut()
            {
                *last |= 1 << self.used;
            }
        }
    }

    /// `n` in the code of order `k`.
    pub(crate) fn golomb(&mut self, n: u64, k: u32) {
        let q = (n >> k) + 1;
        let bits = q.ilog2();
        self.put(0, bits);
        self.put(q, bits + 1);
        self.put(n, k);
    }

    /// `n` as [`BitWriter::golomb`] of 2n, or of −2n − 1 below zero.
    pub(crate) fn signed(&mut self, n: i64, k: u32) {
        self.golomb(zigzag(n), k);
    }

    /// Begins anew.
    pub(super) fn clear(&mut self) {
        self.bytes.clear();
        self.used = 0;
    }

    /// The bytes so far, the last one filled up with zeros.
    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The bytes, the last one filled up with zeros.
    pub(crate) fn finish(self) -> Vec<u8> {
        self.bytes
    }
}

/// The bits of a slice. `None` where they end, or where a number is longer than any there is.
#[derive(Clone, Debug)]
pub(crate) struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    pub(crate) fn take(&mut self, count: u32) -> Option<u64> {
        let mut value = 0;
        for _ in 0..count {
            let byte = self.bytes.get(self.at / 8)?;
            value = value << 1 | u64::from(byte >> (7 - self.at % 8) & 1);
            self.at += 1;
        }
        Some(value)
    }

    pub(crate) fn golomb(&mut self, k: u32) -> Option<u64> {
        let mut bits = 0;
        while self.take(1)? == 0 {
            bits += 1;
            if bits > MAX_BITS {
                return None;
            }
        }
        let q = 1 << bits | self.take(bits)?;
        let low = self.take(k)?;
        let high = (q - 1_u64).checked_mul(1 << k)?;
        Some(high | low).filter(|n| *n < 1 << MAX_BITS)
    }

    pub(crate) fn signed(&mut self, k: u32) -> Option<i64> {
        self.golomb(k).map(unzigzag)
    }

    /// The bytes after the one begun, whatever that is filled up with.
    pub(crate) fn rest(self) -> &'a [u8] {
        &self.bytes[self.at.div_ceil(8)..]
    }

    /// Whether only the filling of the last byte is left, and is zero.
    pub(crate) fn at_end(mut self) -> bool {
        let left = self.bytes.len() * 8 - self.at;
        left < 8 && self.take(left as u32) == Some(0)
    }
}

/// 0, −1, 1, −2, … as 0, 1, 2, 3, …
pub(crate) fn zigzag(n: i64) -> u64 {
    (n << 1 ^ n >> 63) as u64
}

/// What [`zigzag`] was given, of a number below 2⁶³.
pub(crate) fn unzigzag(n: u64) -> i64 {
    let half = (n >> 1) as i64;
    if n & 1 == 0 { half } else { -half - 1 }
}

/// How many bits [`BitWriter::golomb`] takes.
pub(crate) fn golomb_bits(n: u64, k: u32) -> u64 {
    u64::from(2 * ((n >> k) + 1).ilog2() + 1 + k)
}

/// The order in which `numbers` take the fewest bits (of several, the lowest), and how many.
pub(crate) fn best_order(numbers: &[u64]) -> (u32, u64) {
    let bits = |k| numbers.iter().map(|n| golomb_bits(*n, k)).sum();
    let first = (0, bits(0));
    (1..=MAX_ORDER).fold(first, |best, k| {
        let bits = bits(k);
        if bits < best.1 { (k, bits) } else { best }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_codes_are_those_of_the_books() {
        let bits = |n, k| {
            let mut w = BitWriter::default();
            w.golomb(n, k);
            assert!(w.bytes.len() as u64 * 8 - u64::from(w.used) == golomb_bits(n, k));
            w.finish()
        };
        assert_eq!(bits(0, 0), [0b1000_0000]);
        assert_eq!(bits(1, 0), [0b0100_0000]);
        assert_eq!(bits(4, 0), [0b0010_1000]);
        assert_eq!(bits(5, 2), [0b0100_1000]);
        assert_eq!([0, -1, 1, -2].map(zigzag), [0, 1, 2, 3]);
    }

    proptest! {
        #[test]
        fn numbers_come_back(numbers in prop::collection::vec((0u64..1 << 39, 0u32..=MAX_ORDER), 0..40)) {
            let mut w = BitWriter::default();
            for (n, k) in &numbers {
                w.golomb(*n, *k);
                w.signed(-(*n as i64) / 2, *k);
            }
            let bytes = w.finish();
            let mut r = BitReader::new(&bytes);
            for (n, k) in &numbers {
                prop_assert_eq!(r.golomb(*k), Some(*n));
                prop_assert_eq!(r.signed(*k), Some(-(*n as i64) / 2));
            }
            prop_assert!(r.at_end());
        }

        #[test]
        fn any_bytes_read_or_end(bytes: Vec<u8>, k in 0u32..=MAX_ORDER) {
            let mut r = BitReader::new(&bytes);
            while r.golomb(k).is_some() {}
            prop_assert!(r.at <= bytes.len() * 8);
        }
    }
}
