//! Greetings, frames and every message: any bytes are refused, or are the one encoding of what they decode to, and what
//! follows from a message (state, forecast, path) is finite.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_protocol::checkpoint::path::{PathBounds, PathDecoder};
use telemime_protocol::predict::{Forecast, checksum};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::{self, Deframer};
use telemime_protocol::wire::hello::{Answer, Hello};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::WirePose;
use telemime_protocol::wire::v1::*;
use telemime_protocol::wire::{Version, Versions};

fn canonical<M: Message>(bytes: &[u8]) -> Option<M> {
    let message = M::decode(bytes).ok()?;
    assert_eq!(message.encode(), bytes);
    Some(message)
}

fn foretell(state: &WireState, params: &WireParams, pose: &WirePose) {
    let known = state.dequantise();
    assert!(known.is_finite());
    let place = Forecast::constant_velocity(&known, &params.dequantise());
    let turn = pose.turn.map(|t| t.forecast(known.t, None));
    for h in [0.0, 0.1, 2.0] {
        assert!(place.at(h).position.iter().all(|v| v.is_finite()));
        if let Some(turn) = &turn {
            assert!((turn.at(h).orientation.norm() - 1.0).abs() < 1e-6);
        }
    }
    checksum(&place, turn.as_ref());
}

/// As a path of places, and as one of poses.
fn follow(state: &WireState, sent: &KnotBlock, limit: usize) {
    for turn_rad in [None, Some(0.05)] {
        let bounds = PathBounds::new(0.02, turn_rad);
        let code = PathCode::new(bounds, 33_333).expect("a usable bound");
        follow_as(code, state, sent, limit);
    }
}

fn follow_as(code: PathCode, state: &WireState, sent: &KnotBlock, limit: usize) {
    let Ok(knots) = sent.unpack(state, code, &[], limit) else {
        return;
    };
    assert!(knots.len() <= limit);
    // What was read can be written again, and reads the same.
    let again = KnotBlock::pack(state, code, &[], &knots).expect("it has travelled");
    assert_eq!(
        again.unpack(state, code, &[], limit).as_deref(),
        Ok(&knots[..])
    );
    let mut path = PathDecoder::new(code.grid(), limit);
    for knot in &knots {
        let _ = path.append(knot);
    }
    let ends: Vec<Stamp> = path.knots().map(|k| k.t).collect();
    for w in ends.windows(2) {
        let middle = Stamp(w[0].0 + (w[1].0 - w[0].0) / 2);
        if let Some(jet) = path.eval(middle) {
            assert!(jet.x.iter().chain(&jet.v).all(|v| v.is_finite()));
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, bytes)) = data.split_first() else {
        return;
    };
    match kind % 8 {
        0 => match canonical::<OperatorControl>(bytes) {
            Some(OperatorControl::Engage(Engage {
                drive:
                    Drive::Mirror {
                        state,
                        params,
                        pose,
                        ..
                    },
                ..
            })) => foretell(&state, &params, &pose),
            Some(OperatorControl::Path(tail)) => follow(&tail.state, &tail.knots, MAX_TAIL_KNOTS),
            _ => {}
        },
        1 => drop(canonical::<RobotControl>(bytes)),
        2 => {
            if let Some(OperatorDatagram::Motion(motion)) = canonical(bytes) {
                foretell(&motion.state, &motion.params, &motion.pose);
                follow(&motion.state, &motion.knots, MAX_KNOTS);
            }
        }
        3 => drop(canonical::<RobotDatagram>(bytes)),
        4 => {
            let [first, second] =
                [Version::V1, Version::V2].map(|v| v.decode_operator_datagram(bytes));
            if let Ok(message) = &second {
                assert_eq!(Version::V2.encode_operator_datagram(message), bytes);
            }
            // They differ in one message only.
            let pong = |decoded: &_| matches!(decoded, Ok(OperatorDatagram::Pong { .. }));
            if !pong(&first) && !pong(&second) {
                assert_eq!(first.ok(), second.ok());
            }
        }
        5 => {
            if let Ok(Some((hello, used))) = Hello::decode(bytes) {
                assert_eq!(hello.encode(), bytes[..used]);
                for (lowest, highest) in [
                    (Version::V1, Version::V1),
                    (Version::V1, Version::V2),
                    (Version::V2, Version::V2),
                ] {
                    let versions = Versions::new(lowest, highest).expect("in order");
                    if let Some(version) = versions.choose(&hello) {
                        assert!((lowest..=highest).contains(&version));
                        assert!((hello.min..=hello.max).contains(&version.number()));
                    }
                }
            }
        }
        6 => {
            if let Ok(Some((answer, used))) = Answer::decode(bytes) {
                assert_eq!(answer.encode(), bytes[..used]);
            }
        }
        _ => {
            // In pieces of any size the same frames come out.
            let (mut whole, mut pieces) = (Deframer::default(), Deframer::default());
            whole.push(bytes);
            let all: Vec<_> = std::iter::from_fn(|| whole.next_frame().ok().flatten()).collect();
            let mut told = Vec::new();
            for piece in bytes.chunks(1 + usize::from(kind >> 3)) {
                pieces.push(piece);
                while let Ok(Some(frame)) = pieces.next_frame() {
                    told.push(frame);
                }
            }
            assert_eq!(all, told);
            let again: Vec<u8> = all
                .iter()
                .flat_map(|f| frame::encode(&f.payload, f.ignorable))
                .collect();
            assert!(bytes.starts_with(&again));
        }
    }
});
