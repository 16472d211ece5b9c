//! What a message and a tick cost: `cargo bench -p telemime-protocol --features testing --bench predict`.

use divan::{Bencher, black_box};
use nalgebra::Vector3;
use telemime_protocol::pose;
use telemime_protocol::predict::{HandState, Params, TurnState};
use telemime_protocol::skill::{Skill, posed_example};
use telemime_protocol::time::Stamp;

fn main() {
    divan::main();
}

const PARAMS: Params = Params::only([0.7, 0.1, 0.1]);

/// Components that are learned: of one person's demonstrations, and with other people's beside them.
const LEARNED: [usize; 2] = [14, 21];

fn skill(components: usize) -> Skill {
    posed_example(components, 24)
}

fn hand() -> HandState {
    let mut state = HandState::first(Stamp(0), Vector3::new(0.1, 0.2, 0.3));
    for i in 1..40_i64 {
        let u = i as f64 * 0.1;
        state.advance(
            Stamp(i * 33_000_000),
            Vector3::new(libm::sin(u), libm::cos(u), 0.01 * u),
        );
    }
    state
}

/// A message: the forecast of 24 knots.
#[divan::bench(args = LEARNED)]
fn message(bencher: Bencher, components: usize) {
    let (skill, hand) = (skill(components), hand());
    bencher.bench(|| skill.predictor().forecast(black_box(&hand), &PARAMS));
}

/// The same of the orientation.
#[divan::bench(args = LEARNED)]
fn message_turn(bencher: Bencher, components: usize) {
    let skill = skill(components);
    let turn = &skill.turn().expect("the example turns").predictor;
    let mut state = TurnState::first(Stamp(0), pose::exp(&Vector3::x()));
    for i in 1..40_i64 {
        let q = pose::exp(&Vector3::new(1.0, 0.02 * i as f64, 0.0));
        state.advance(Stamp(i * 33_000_000), q);
    }
    bencher.bench(|| turn.forecast(black_box(&state), &PARAMS));
}

/// A tick: one moment of a forecast that is there.
#[divan::bench]
fn tick(bencher: Bencher) {
    let forecast = skill(LEARNED[1]).predictor().forecast(&hand(), &PARAMS);
    bencher.bench(|| forecast.at(black_box(0.137)));
}

/// A tick of the orientation.
#[divan::bench]
fn tick_turn(bencher: Bencher) {
    let skill = skill(LEARNED[1]);
    let turn = &skill.turn().expect("the example turns").predictor;
    let state = TurnState::first(Stamp(0), pose::exp(&Vector3::x()));
    let forecast = turn.forecast(&state, &PARAMS);
    bencher.bench(|| forecast.at(black_box(0.137)));
}
