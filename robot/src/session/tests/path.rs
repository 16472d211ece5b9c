//! The path: complete, in order, whatever the link does to it.

use super::*;

/// Two seconds of a moving hand, as the operator sends it: the knots in order, with the time of their making.
fn knots(bench: &Bench) -> Vec<PoseKnot> {
    let mut encoder = PathEncoder::new(0.02).unwrap();
    let mut knots = Vec::new();
    for i in 0..60 {
        let t = Stamp(bench.stamp(0).0 + i * 33 * MS);
        let phase = i as f64 * 0.5;
        let x = hand() + Vector3::new(0.4 * phase.sin(), 0.2 * phase.cos(), 0.0);
        knots.extend(encoder.push(t, x).unwrap());
    }
    knots.extend(encoder.flush());
    assert!(knots.len() > 8, "{}", knots.len());
    knots.into_iter().map(PoseKnot::from).collect()
}

impl Bench {
    /// Sends `knots[range]`, with a state just after the last of them.
    fn send_knots(&mut self, seq: u32, knots: &[PoseKnot], range: std::ops::Range<usize>) {
        let last = knots[range.end - 1];
        let t = Stamp(last.tick * TICK_NS + MS);
        self.now = Mono(t.0 - OFFSET + 50 * MS);
        let state = WireState::quantise(&moving(t)).unwrap();
        let code = PathCode::new(PathBounds::new(0.02, None), 33_333).unwrap();
        let (before, due) = knots[..range.end].split_at(range.start);
        let motion = Motion {
            state,
            first_knot: range.start as u32,
            knots: KnotBlock::pack(&state, code, before, due).unwrap(),
            ..self.motion(seq, 0)
        };
        self.send(&motion);
    }

    fn frontier(&self) -> u32 {
        self.session.mirror().unwrap().frontier()
    }
}

#[test]
fn repeated_knots_count_once_and_a_gap_waits() {
    let mut bench = Bench::mirroring(None);
    let knots = knots(&bench);
    bench.send_knots(1, &knots, 0..3);
    assert_eq!(bench.frontier(), 3);
    bench.send_knots(2, &knots, 1..4);
    assert_eq!(bench.frontier(), 4);
    bench.send_knots(3, &knots, 5..7);
    assert_eq!(bench.frontier(), 4, "knot 4 is missing");
    bench.send_knots(4, &knots, 2..4);
    assert_eq!(bench.frontier(), 4, "all known");
    bench.send_knots(5, &knots, 3..knots.len());
    assert_eq!(bench.frontier() as usize, knots.len());
    assert_eq!(bench.dropped(), 0);

    let grid = PathBounds::new(0.02, None).grid().unwrap();
    let held = bench.session.mirror().unwrap().path().knots();
    let sent = knots.iter().map(|k| grid.dequantise(k).unwrap());
    assert!(held.copied().eq(sent), "every knot, in order, to the bit");
}

#[test]
fn an_overtaken_message_still_fills_its_gap() {
    let mut bench = Bench::mirroring(None);
    let knots = knots(&bench);
    bench.send_knots(2, &knots, 4..6);
    let leases = bench.leases_ms().len();
    bench.send_knots(1, &knots, 0..5);
    assert_eq!(bench.frontier(), 5);
    assert_eq!(
        bench.leases_ms().len(),
        leases,
        "but the future stays the newest"
    );
}

#[test]
fn knots_that_cannot_be_leave_the_path_as_it_was() {
    let mut bench = Bench::mirroring(None);
    let knots = knots(&bench);
    bench.send_knots(1, &knots, 0..2);
    let mut far = knots.clone();
    // Further on than a span can be.
    far[2].tick = far[1].tick + 100_001;
    far[2].v = [0; 7];
    bench.send_knots(2, &far, 2..3);
    // Not the knots it says it holds.
    let noise = Motion {
        state: WireState::quantise(&moving(bench.stamp(0))).unwrap(),
        first_knot: 2,
        knots: KnotBlock(vec![0x80, 0, 0, 0]),
        ..bench.motion(3, 0)
    };
    bench.send(&noise);
    assert_eq!(bench.frontier(), 2);
    bench.send_knots(4, &knots, 2..3);
    assert_eq!(bench.frontier(), 3);
}

#[test]
fn telemetry_acknowledges_and_a_new_engagement_starts_at_zero() {
    let mut bench = Bench::mirroring(None);
    let knots = knots(&bench);
    bench.send_knots(1, &knots, 0..4);
    let acknowledged = |bench: &mut Bench| {
        bench.datagrams.clear();
        bench.pass(300);
        let now = bench.now;
        bench.session.handle_timeout(now);
        bench.drain();
        let frontier = |d: &RobotDatagram| match d {
            RobotDatagram::Telemetry(t) => Some(t.path_frontier),
            RobotDatagram::Ping { .. } | RobotDatagram::Reception(_) | RobotDatagram::Servo(_) => {
                None
            }
        };
        bench.datagrams.iter().find_map(frontier)
    };
    assert_eq!(acknowledged(&mut bench), Some(4));
    bench.reports(RobotState::Ready);
    let engage = bench.mirror(2);
    assert_eq!(bench.refusal(&engage), None);
    assert_eq!(acknowledged(&mut bench), Some(0));
}
