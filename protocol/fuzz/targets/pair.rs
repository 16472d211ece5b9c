//! Pairing, which strangers reach while a window is open: any bytes are refused, or wait for more, or begin with the one
//! encoding of a message; in pieces the same.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_protocol::wire::pair::{MAX_LEN, Name, PairMessage};

fuzz_target!(|bytes: &[u8]| {
    let mut rest = bytes;
    loop {
        match PairMessage::decode(rest) {
            Ok(Some((message, used))) => {
                assert_eq!(message.encode(), rest[..used]);
                assert!((1..=MAX_LEN).contains(&used));
                for n in 0..used {
                    assert_eq!(PairMessage::decode(&rest[..n]), Ok(None));
                }
                rest = &rest[used..];
            }
            Ok(None) => {
                assert!(rest.len() < MAX_LEN, "more than any message needs");
                break;
            }
            Err(refused) => {
                // More bytes do not make it better.
                let longer = [rest, b"TLMP"].concat();
                assert_eq!(PairMessage::decode(&longer), Err(refused));
                break;
            }
        }
    }
    let name = Name::made_of(&String::from_utf8_lossy(bytes));
    assert_eq!(Name::new(name.as_ref()), Some(name));
});
