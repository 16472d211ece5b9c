//! Datagrams: what is taken, what is dropped, for how long it authorises motion.

use super::*;
use telemime_protocol::predict::{Forecast, checksum};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::v1::model_tag;

fn go(bench: &Bench, seq: u32, ms_ago: i64) -> OperatorDatagram {
    OperatorDatagram::Go {
        epoch: EPOCH,
        engagement: 1,
        seq,
        t_us: bench.stamp(ms_ago).0 / 1000,
        lease_ms: 650,
        bend: None,
    }
}

/// A session that plays a plan as engagement 1.
fn playing() -> Bench {
    let mut bench = Bench::ready(None);
    let x = [hand(), hand() + Vector3::x(), hand()];
    let plan: PosePlan = select::bounded(&[0.0, 1.0, 2.0], &x, 0.01).unwrap().into();
    bench.control(&OperatorControl::Plan {
        id: 1,
        bytes: codec::encode(&plan),
    });
    let engage = Engage {
        drive: Drive::Play { plan: 1 },
        ..bench.mirror(1)
    };
    bench.engage(&engage);
    bench.reports(RobotState::Engaged);
    bench.forget();
    bench
}

#[test]
fn what_is_foreign_malformed_or_impossible_is_dropped_and_counted() {
    let mut bench = Bench::mirroring(None);
    let good = bench.motion(1, 100);
    let motion = |change: fn(&mut Motion)| {
        let mut motion = good.clone();
        change(&mut motion);
        OperatorDatagram::Motion(motion).encode()
    };
    let mut trailing = OperatorDatagram::Motion(good.clone()).encode();
    trailing.push(0);
    // The epoch in three bytes instead of one.
    let mut long_form = OperatorDatagram::Stop { epoch: EPOCH }.encode();
    assert_eq!(long_form, [3, EPOCH as u8]);
    long_form.splice(1..2, [0xfb, EPOCH as u8, 0]);
    let bad = [
        motion(|m| m.epoch += 1),
        motion(|m| m.engagement = 0),
        motion(|m| m.engagement = 2),
        motion(|m| m.state.x[1] = 2_000_000),
        motion(|m| m.state.t_us = i64::MIN),
        // Later than now by more than a clock can be off.
        motion(|m| m.state.t_us += 700_000),
        // The lease has run out on the way.
        motion(|m| m.state.t_us -= 1_100_000),
        trailing,
        long_form,
        go(&bench, 1, 0).encode(),
        OperatorDatagram::Stop { epoch: EPOCH - 1 }.encode(),
        OperatorDatagram::Pong {
            epoch: EPOCH + 1,
            t1_us: 0,
            t2_us: 0,
            t3_us: 0,
        }
        .encode(),
        vec![],
        vec![0xff; 1100],
        vec![0; 1101],
    ];
    for (i, bytes) in bad.iter().enumerate() {
        bench.bytes(bytes);
        assert_eq!(bench.dropped() as usize, i + 1, "number {i} was taken");
        assert!(bench.orders.is_empty(), "{i}: {:?}", bench.orders);
        assert!(bench.control.is_empty());
    }
    bench.pass(50);
    let good = bench.motion(2, 100);
    bench.send(&good);
    assert_eq!(bench.leases_ms(), [650], "and the session goes on");
}

#[test]
fn nothing_moves_before_an_engagement() {
    let mut bench = Bench::ready(None);
    for engagement in [0, 1] {
        let motion = Motion {
            engagement,
            ..bench.motion(1, 50)
        };
        bench.send(&motion);
    }
    assert_eq!((bench.dropped(), bench.orders.len()), (2, 0));
}

#[test]
fn the_lease_shrinks_by_what_a_message_is_too_late() {
    let mut bench = Bench::mirroring(None);
    for (seq, ms_ago, lease_ms) in [(1, 1100, 50), (2, 700, 450), (3, 500, 650), (4, 20, 650)] {
        bench.forget();
        let motion = bench.motion(seq, ms_ago);
        bench.send(&motion);
        assert_eq!(bench.leases_ms(), [lease_ms], "{ms_ago} ms old");
    }
    assert_eq!(bench.dropped(), 0);
    let [Order::Track { valid_at, .. }] = bench.orders[..] else {
        panic!()
    };
    let error_ns = valid_at.0 - (bench.now.0 - 20 * MS);
    assert!(
        error_ns.abs() <= 1000,
        "the age is that of the sample: {error_ns}"
    );
}

#[test]
fn the_longest_lease_cannot_be_outbid_by_what_is_too_old() {
    let mut bench = Bench::mirroring(None);
    for (seq, ms_ago, leases) in [
        (1, 60_000, &[][..]),
        (2, 1600, &[]),
        (3, 1400, &[100]),
        (4, 20, &[1000]),
    ] {
        bench.forget();
        let motion = Motion {
            lease_ms: 65_000,
            ..bench.motion(seq, ms_ago)
        };
        bench.send(&motion);
        assert_eq!(bench.leases_ms(), leases, "{ms_ago} ms old");
    }
    assert_eq!(bench.dropped(), 2);
}

#[test]
fn a_delay_that_is_less_than_a_millisecond_is_one_and_none_is_what_is_not_known() {
    let mut bench = Bench::mirroring(None);
    let delay_ms = |bench: &mut Bench| {
        bench.forget();
        bench.pass(50);
        bench.session.handle_timeout(bench.now);
        bench.drain();
        let told = bench.datagrams.iter().find_map(|datagram| match datagram {
            RobotDatagram::Telemetry(telemetry) => Some(telemetry.delay_ms),
            _ => None,
        });
        told.unwrap()
    };
    assert_eq!(delay_ms(&mut bench), 0, "nothing has arrived");
    // From the same moment, and from one a little ahead of the clock's estimate.
    for (seq, ms_ago, told) in [(1, 0, 1), (2, -3, 1), (3, 7, 7)] {
        bench.pass(50);
        let motion = bench.motion(seq, ms_ago);
        bench.send(&motion);
        assert_eq!(delay_ms(&mut bench), told, "{ms_ago}");
    }
}

#[test]
fn only_a_newer_sample_is_followed() {
    let mut bench = Bench::mirroring(None);
    let older = bench.motion(1, 80);
    let newer = bench.motion(2, 40);
    // Sent later, about an earlier moment.
    let odd = bench.motion(3, 60);
    for motion in [&newer, &older, &newer, &odd] {
        bench.send(motion);
    }
    assert_eq!(bench.leases_ms().len(), 1);
    let Order::Track { forecast, .. } = &bench.orders[0] else {
        panic!()
    };
    assert_eq!(forecast.t, newer.state.dequantise().t);
    let counters = bench.session.counters();
    assert_eq!(
        (counters.received, counters.dropped),
        (3, 2),
        "an overtaken one has arrived all the same; what comes to no use counts as dropped"
    );
}

#[test]
fn the_model_named_predicts_and_any_other_is_constant_velocity() {
    let skill = example(2, 24);
    let tag = model_tag(&skill.id().0);
    let mut bench = Bench::mirroring(Some(skill.clone()));
    for (seq, model) in [(1, 0), (2, tag ^ 1), (3, tag)] {
        bench.pass(10);
        bench.forget();
        let motion = Motion {
            model,
            ..bench.motion(seq, 50)
        };
        bench.send(&motion);
        let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
        let expected = if model == tag {
            skill.predictor().forecast(&state, &params)
        } else {
            Forecast::constant_velocity(&state, &params)
        };
        let [Order::Track { forecast, .. }] = &bench.orders[..] else {
            panic!("{:?}", bench.orders)
        };
        assert_eq!(*forecast, expected);
    }
}

#[test]
fn a_divergence_is_reported_once_and_the_rest_is_constant_velocity() {
    let skill = example(2, 24);
    let mut bench = Bench::mirroring(Some(skill.clone()));
    let tag = model_tag(&skill.id().0);
    let track = |bench: &mut Bench, seq, checksum: &dyn Fn(&Forecast) -> Option<u32>| {
        bench.pass(10);
        bench.orders.clear();
        let mut motion = Motion {
            model: tag,
            ..bench.motion(seq, 50)
        };
        let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
        let own = skill.predictor().forecast(&state, &params);
        motion.checksum = checksum(&own);
        bench.send(&motion);
        let [Order::Track { forecast, .. }] = &bench.orders[..] else {
            panic!("{:?}", bench.orders)
        };
        if *forecast == own {
            return true;
        }
        assert_eq!(*forecast, Forecast::constant_velocity(&state, &params));
        false
    };
    assert!(track(&mut bench, 1, &|own| Some(checksum(own, None))));
    assert!(track(&mut bench, 2, &|_| None));
    assert_eq!(bench.refusals(), []);
    assert!(!track(&mut bench, 3, &|own| Some(checksum(own, None) ^ 1)));
    assert_eq!(bench.refusals(), [Refusal::Diverged]);
    assert!(!track(&mut bench, 4, &|own| Some(checksum(own, None))));
    assert!(!track(&mut bench, 5, &|own| Some(checksum(own, None) ^ 1)));
    assert_eq!(bench.refusals(), [Refusal::Diverged]);
    assert_eq!(bench.dropped(), 0);
}

#[test]
fn goes_extend_the_lease_in_order_and_within_time() {
    let mut bench = playing();
    let goes = [
        (1, 100, Some(650)),
        (1, 90, None),
        (3, 700, Some(450)),
        (2, 10, None),
        (4, 1150, None),
        (5, -700, None),
        (6, 0, Some(650)),
    ];
    let mut dropped = 0;
    for (seq, ms_ago, expected) in goes {
        bench.forget();
        let go = go(&bench, seq, ms_ago);
        bench.datagram(&go);
        assert_eq!(bench.leases_ms().first().copied(), expected, "{seq}");
        dropped += u32::from(expected.is_none());
        assert_eq!(bench.dropped(), dropped, "{seq}");
    }
    bench.forget();
    let motion = bench.motion(9, 50);
    bench.send(&motion);
    assert!(bench.orders.is_empty(), "no hand drives a plan");
}

/// A hand that holds on, its sample `ms_ago` old when the message is sent now.
fn bent(bench: &Bench, ms_ago: i64) -> WireBend {
    let mut state = moving(bench.stamp(ms_ago));
    state.x -= hand();
    state.memory.iter_mut().for_each(|m| *m -= hand());
    WireBend {
        plan_us: 700_000,
        rate: 64,
        left: [100, 0, 0],
        held: Some(WireHeld {
            state: WireState::quantise(&state).unwrap(),
            gain: 255,
            straight: 128,
            weight: [127, 0, 64, 0, 0, 0],
        }),
    }
}

#[test]
fn what_a_hand_makes_of_a_plan_is_ordered_on_the_robots_clock() {
    let mut bench = playing();
    let with = |bench: &Bench, number: u32, ms_ago: i64, bend| match go(bench, number, ms_ago) {
        OperatorDatagram::Go {
            epoch,
            engagement,
            seq,
            t_us,
            lease_ms,
            ..
        } => OperatorDatagram::Go {
            epoch,
            engagement,
            seq,
            t_us,
            lease_ms,
            bend: Some(bend),
        },
        other => other,
    };
    let bend = bent(&bench, 110);
    let go = with(&bench, 1, 100, bend);
    bench.datagram(&go);
    let [
        Order::Extend {
            bent: Some(bent), ..
        },
    ] = &bench.orders[..]
    else {
        panic!("{:?}", bench.orders)
    };
    let near = |at: Mono, ms_ago: i64| (at.0 - (bench.now.0 - ms_ago * MS)).abs() < MS;
    assert!(near(bent.at, 100) && near(bent.sampled_at, 110));
    assert_eq!(bent.bend, bend.dequantise());
    assert!((bent.plan_s(bench.now) - 0.75).abs() < 1e-3);

    // Later than it was sent, by more than clocks are off; and from beyond the ranges.
    let future = with(&bench, 2, 0, super::datagrams::bent(&bench, -600));
    let mut weightless = bend;
    if let Some(held) = &mut weightless.held {
        held.weight[0] = -1;
    }
    let fast = WireBend { rate: 193, ..bend };
    let wrong = [
        future,
        with(&bench, 2, 0, weightless),
        with(&bench, 2, 0, fast),
    ];
    for (i, wrong) in wrong.iter().enumerate() {
        bench.forget();
        bench.datagram(wrong);
        assert!(bench.orders.is_empty(), "{i}");
        assert_eq!(bench.dropped(), i as u32 + 1);
    }
}

#[test]
fn a_stop_datagram_stops_at_once() {
    let mut bench = Bench::mirroring(None);
    bench.datagram(&OperatorDatagram::Stop { epoch: EPOCH });
    assert_eq!(bench.brakes, [Cause::OperatorStop]);
}

#[test]
fn a_step_of_the_session_clock_is_a_hold_while_following_and_nothing_before() {
    let step = 200 * MS;
    let mut bench = Bench::ready(None);
    bench.exchange(step, 60);
    assert!(bench.orders.is_empty());
    assert_eq!(
        bench.session.clock().to_session(bench.now),
        Some(Stamp(bench.now.0 + OFFSET + step)),
        "applied at once"
    );

    let mut bench = Bench::mirroring(None);
    bench.exchange(20 * MS, 90);
    assert!(bench.orders.is_empty(), "drift is followed smoothly");
    bench.exchange(step, 60);
    assert_eq!(bench.brakes, [Cause::ClockStep]);
}

#[test]
fn pings_and_telemetry_go_out_at_their_times() {
    let mut bench = Bench::mirroring(None);
    let motion = bench.motion(5, 80);
    bench.send(&motion);
    bench.bytes(&[9, 9]);
    bench.forget();
    let begun = bench.now;
    while bench.now.secs_since(begun) < 1.0 {
        let (due, reason) = bench.session.poll_timeout();
        assert!(!reason.is_empty());
        bench.now = due.max(bench.now);
        let now = bench.now;
        bench.session.handle_timeout(now);
        bench.drain();
    }
    let (mut pings, mut telemetry, mut reception) = (0, Vec::new(), Vec::new());
    let mut servo = Vec::new();
    for datagram in &bench.datagrams {
        match datagram {
            RobotDatagram::Ping { epoch: EPOCH, .. } => pings += 1,
            RobotDatagram::Telemetry(t) => telemetry.push(t.clone()),
            RobotDatagram::Reception(r) => reception.push(*r),
            RobotDatagram::Servo(times) => servo.push(*times),
            other => panic!("{other:?}"),
        }
    }
    // Eight in quick succession, then four a second.
    assert!((10..=13).contains(&pings), "{pings}");
    assert!((19..=22).contains(&telemetry.len()), "{}", telemetry.len());
    assert!(telemetry.windows(2).all(|w| w[1].seq == w[0].seq + 1));
    let t = &telemetry[0];
    assert_eq!(
        (t.received, t.newest_seq, t.dropped, t.delay_ms),
        (1, 5, 1, 80)
    );
    assert!((2..=3).contains(&reception.len()), "{}", reception.len());
    assert_eq!(servo.len(), reception.len());
    let times = ServoTimes {
        epoch: EPOCH,
        ticks: 60_000,
        overruns: 2,
        mean_ns: 5_600,
        work_ns: [1, 2, 3, 4],
        wake_ns: [5, 6, 7, 8],
    };
    assert_eq!(servo[0], times);
    let r = &reception[0];
    assert_eq!((r.epoch, r.newest_seq, r.received), (EPOCH, 5, 1));
    assert_eq!((r.loss_runs, r.longest_loss_run), (1, 4));
    assert!(r.delay_us.iter().all(|us| us.abs_diff(80_000) < 5_000));
    assert_eq!((t.epoch, t.engagement, t.q.len()), (EPOCH, 1, 7));
    assert!((49_000..=51_000).contains(&t.clock_uncertainty_us));
}
