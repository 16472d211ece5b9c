//! Every bit of a fixed run of the predictor, one line a query: two builds that print the same predict alike.
//!
//! `.ci/bits` builds it for a plain and for a modern processor and compares what they print.

use std::process::ExitCode;

use nalgebra::Vector3;
use telemime_protocol::pose;
use telemime_protocol::predict::{Ahead, HandState, Params, TurnState, checksum};
use telemime_protocol::skill::posed_example;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::WireParams;

const QUERIES: i64 = 400;

fn main() -> ExitCode {
    let skill = posed_example(14, 24);
    let Some(turned) = skill.turn() else {
        eprintln!("the example has no orientation");
        return ExitCode::FAILURE;
    };
    let at = |u: f64| Vector3::new(libm::sin(0.31 * u), 0.7 * libm::cos(0.23 * u), 0.002 * u);
    let about = |u: f64| pose::exp(&(at(1.7 * u) * 1.5));
    let mut hand = HandState::first(Stamp(0), at(0.0));
    let mut wrist = TurnState::first(Stamp(0), about(0.0));
    for i in 1..=QUERIES {
        let (u, t) = (i as f64 * 0.1, Stamp(i * 33_000_000 + i * i * 1000));
        hand.advance(t, at(u));
        wrist.advance(t, about(u));
        let params = params(i).dequantise();
        let place = skill.predictor().forecast(&hand, &params);
        let turn = turned.predictor.forecast(&wrist, &params);
        let mut bytes = Vec::new();
        for (ahead, start) in [
            (&place.ahead, place.x.as_slice()),
            (&turn.ahead, turn.q.coords.as_slice()),
        ] {
            bits(ahead, start, &mut bytes);
        }
        for h_s in [0.01, 0.15, 0.37, 0.9] {
            let (p, q) = (place.at(h_s), turn.at(h_s));
            let values = p.position.iter().chain(&q.orientation.coords);
            values
                .chain([&p.sigma_m, &q.sigma_rad])
                .for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        println!(
            "{i} {:016x} {:08x}",
            fnv(&bytes),
            checksum(&place, Some(&turn))
        );
    }
    ExitCode::SUCCESS
}

/// Weights and factors of every kind, from full trust to none.
fn params(i: i64) -> WireParams {
    let step = |k: i64| (i * k % 86) as u8;
    let band = |k| [step(k), step(k + 4), step(k + 10)];
    if i % 5 == 0 {
        WireParams::quantise(&Params::DEFAULT)
    } else {
        WireParams {
            gain: 255 - step(3),
            inflation: 100 + step(7),
            weights: [band(13), band(29), band(51)],
        }
    }
}

fn bits(ahead: &Ahead, start: &[f64], out: &mut Vec<u8>) {
    let knots = ahead.knots.iter().flat_map(|k| {
        let values = k.displacement.iter().chain(&k.covariance);
        values.chain([&k.sigma]).copied().collect::<Vec<_>>()
    });
    let values = start.iter().copied().chain(knots);
    for v in values.chain([ahead.novelty, ahead.familiarity]) {
        out.extend(v.to_le_bytes());
    }
}

fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, b| {
        (hash ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}
