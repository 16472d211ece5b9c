//! Motions that are none, bit by bit (docs/protocol.md §5).

use telemime_protocol::wire::v1::*;

use super::super::messages::OPERATOR_DATAGRAM;

/// The fields of a motion in order, each as its bits in words.
type Fields = [(&'static str, String)];

/// A motion of no engagement worth the name, all at its origin, but for how something in it is written.
fn written(change: fn(&mut Fields)) -> Vec<u8> {
    let mut fields = [
        ("flags", "00000"),
        ("kind", "000"),
        ("epoch", "1000"),
        ("engagement", "1001"),
        ("seq", "100000001"),
        ("lease", "01000001"),
        ("gain", "1"),
        ("inflation", "10000000"),
        ("weights", "111100000000111100000000111100000000"),
        ("t", "00000000000000000000000000000000"),
        ("x", "100000000000000100000000000000100000000000000"),
        ("exponents", "0000111"),
        (
            "offsets",
            "100001000010000100001000010000100001000010000100001000010000",
        ),
        ("rest", ""),
    ]
    .map(|(name, bits)| (name, bits.to_owned()));
    change(&mut fields);
    let mut bits: Vec<u8> = fields.iter().flat_map(|f| f.1.bytes()).collect();
    let filled = bits.len().next_multiple_of(8);
    bits.resize(filled, b'0');
    let byte = |eight: &[u8]| eight.iter().fold(0, |n, bit| n << 1 | (bit - b'0'));
    bits.chunks(8).map(byte).collect()
}

pub(super) fn motions(say: &mut impl FnMut(&'static str, &str, Vec<u8>, &'static str)) {
    assert!(OperatorDatagram::decode(&written(|_| ())).is_ok());
    type Case = (&'static str, fn(&mut Fields), &'static str);
    let cases: [Case; 14] = [
        (
            "other bits in the kind",
            |f| f[1].1 = "111".into(),
            "Malformed",
        ),
        (
            "an epoch beyond 32 bits",
            |f| f[2].1 = format!("{:0>31}{:0>33}", 1, 0),
            "Malformed",
        ),
        (
            "a number without an end",
            |f| f[4].1 = "0".repeat(64),
            "Malformed",
        ),
        (
            "a whole gain spelled out",
            |f| f[6].1 = "011111111".into(),
            "NotCanonical",
        ),
        (
            "weights of 16/15",
            |f| f[8].1.replace_range(4..8, "0001"),
            "Invalid",
        ),
        (
            "a time longer than it has to be",
            |f| f[9].1 = format!("01{:0>38}", 1),
            "NotCanonical",
        ),
        (
            "a time beyond the session clock",
            |f| f[9].1 = "1".repeat(56),
            "Invalid",
        ),
        (
            "a hand beyond 32 bits",
            |f| {
                f[10]
                    .1
                    .replace_range(0..15, &format!("{:0>20}{:0>33}", 1, 0))
            },
            "Malformed",
        ),
        (
            "a hand beyond 100 m, in bits",
            |f| {
                f[10]
                    .1
                    .replace_range(0..15, &format!("{:0>8}{:0>21}", 1, 0))
            },
            "Invalid",
        ),
        (
            "an exponent below 0",
            |f| f[11].1 = "000001011".into(),
            "Malformed",
        ),
        (
            "an exponent above 15",
            |f| f[11].1 = "111101111".into(),
            "Malformed",
        ),
        (
            "a step beyond a byte",
            |f| f[12].1.replace_range(0..5, "0000100010000"),
            "Malformed",
        ),
        (
            "filled up with ones",
            |f| f[13].1 = "1".into(),
            "NotCanonical",
        ),
        (
            "knots without any",
            |f| {
                f[0].1 = "00001".into();
                f[13].1 = "100000000".into();
            },
            "NotCanonical",
        ),
    ];
    for (name, change, error) in cases {
        say(OPERATOR_DATAGRAM, name, written(change), error);
    }
}
