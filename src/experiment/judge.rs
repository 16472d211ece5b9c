//! A run against the hand it was to follow.

use nalgebra::Vector3;
use telemime_operator::cli::Axes;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::session::SessionConfig;
use telemime_protocol::pose;

use super::drive::{driven, from_zero, session};
use super::factor::Settings;
use super::figures::{Figures, HORIZONS_S};
use super::method::{Method, Sender};
use super::subject::Subject;
use super::trace::{Outcome, Tick, Trace};
use crate::evaluate::{Guess, Live, REGION_90, on_session_clock};
use crate::measure::{
    Passing, Spread, Track, Turns, amplitude_gain, off_path, overshoots, quantile, rms, shift,
    smooth_jerk_m_s3,
};

/// What is judged is judged every millisecond.
const GRID_S: f64 = 1e-3;

/// Shifts are sought from this much early to this much late, in steps of the grid.
const EARLY: usize = 200;
const LATE: usize = 800;

/// Shift and distance look at every eighth millisecond.
const STRIDE: usize = 8;

/// The path is sought this many milliseconds before and after.
const REACH: usize = 1000;

/// A tip's reversal is sought until this long after the hand's, ms.
const REVERSAL: usize = 400;

/// At rest the tip is nearer than this to where it stays, m of the robot.
const STILL_M: f64 = 1e-4;

/// A stop that begins this long after the outage's end is another's, s: the last of the lease, and the arm's.
const AFTER_S: f64 = 1.0;

/// One moment of a run, for figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moment {
    pub(super) t_s: f64,
    pub(super) hand_m: Vector3<f64>,
    pub(super) tip_m: Vector3<f64>,
    pub(super) age_s: Option<f64>,
}

/// The figures of a run, and its course every 20 ms.
pub(super) fn judge(
    settings: &Settings,
    subject: &Subject,
    trace: &Trace,
    axes: Axes,
) -> (Figures, Vec<Moment>) {
    let d = driven(settings, subject);
    let samples = from_zero(d);
    let truth = Track::new(samples.iter().map(|s| (s.t_s, s.position)).collect())
        .expect("a demonstration is in order and finite");
    let end_s = truth.span_s().1;
    let mut figures = Figures {
        scale: Some(trace.scale).filter(|s| s.is_finite()),
        operator_cpu: trace.cpu.map(|(operator, _)| operator),
        robot_cpu: trace.cpu.map(|(_, robot)| robot),
        ..Figures::default()
    };
    if let Outcome::NotDriven(_) = trace.outcome {
        figures.followed = Some(0.0);
    }
    wire(&mut figures, trace, end_s);
    prediction(&mut figures, settings, subject, d, axes);
    if let Some(outage_s) = settings.outage_s {
        outage(&mut figures, trace, outage_s, end_s);
    }
    let judged: Vec<&Tick> = trace
        .ticks
        .iter()
        .filter(|t| (0.0..end_s).contains(&t.t_s))
        .collect();
    let Some(from_s) = judged.first().map(|t| t.t_s) else {
        return (figures, Vec::new());
    };
    let n = judged.len();
    let tip: Vec<_> = judged.iter().map(|t| t.tip_m).collect();
    let at = |i: i64| truth.at(from_s + i as f64 * GRID_S);
    let wide: Vec<_> = (-(LATE as i64)..(n + EARLY) as i64).map(at).collect();
    let hand = &wide[LATE..LATE + n];
    figures.judged_s = Some(n as f64 * GRID_S);
    let followed = judged.iter().filter(|t| t.follows).count();
    figures.followed = Some(followed as f64 / n as f64);
    let errors = tip.iter().zip(hand).map(|(a, b)| (a - b).norm());
    if let Some(error) = Spread::of(errors) {
        figures.rmse_m = Some(error.rms);
        figures.error_p99_m = Some(error.p99);
        figures.error_max_m = Some(error.max);
    }
    let (late, rest_m) = shift(&tip, &wide, (LATE, EARLY), STRIDE);
    // At the edge the true one may be beyond.
    if late != LATE as i64 && late != -(EARLY as i64) {
        figures.lag_s = Some(late as f64 * GRID_S);
        figures.value_rmse_m = Some(rest_m);
    }
    let mut off = off_path(&tip, hand, REACH, STRIDE);
    figures.spatial_mean_m = Some(off.iter().sum::<f64>() / off.len() as f64);
    figures.spatial_p95_m = quantile(&mut off, 0.95);
    figures.amplitude_gain = amplitude_gain(&tip, hand);
    let beyond = overshoots(&tip, hand, REVERSAL);
    figures.overshoot_m =
        (!beyond.is_empty()).then(|| beyond.iter().sum::<f64>() / beyond.len() as f64);
    let jerk = rms(judged.iter().map(|t| t.jerk_m_s3));
    let hand_jerk = trace.scale * smooth_jerk_m_s3(&truth, from_s, end_s);
    figures.jerk_m_s3 = Some(jerk);
    figures.jerk_ratio = (hand_jerk > 0.0).then_some(jerk / hand_jerk);
    figures.clamps = Some(judged.iter().filter(|t| t.limited).count() as f64);
    let mut ages: Vec<_> = judged.iter().filter_map(|t| t.age_s).collect();
    figures.age_p50_s = quantile(&mut ages, 0.5);
    figures.age_p95_s = quantile(&mut ages, 0.95);
    figures.age_p99_s = quantile(&mut ages, 0.99);
    let turned = samples.iter().map(|s| Some((s.t_s, s.orientation?)));
    if let Some(turns) = turned.collect::<Option<Vec<_>>>().and_then(Turns::new) {
        let angle = |t: &&Tick| Some(pose::between(&turns.at(t.t_s), &t.turn?).norm());
        if let Some(error) = Spread::of(judged.iter().filter_map(angle)) {
            figures.turn_rmse_rad = Some(error.rms);
            figures.turn_p99_rad = Some(error.p99);
            figures.turn_max_rad = Some(error.max);
        }
    }
    let moments = judged
        .iter()
        .zip(hand)
        .step_by(20)
        .map(|(t, hand_m)| Moment {
            t_s: t.t_s,
            hand_m: *hand_m,
            tip_m: t.tip_m,
            age_s: t.age_s,
        });
    (figures, moments.collect())
}

/// While the recording lasts.
fn wire(figures: &mut Figures, trace: &Trace, end_s: f64) {
    figures.messages_per_s = Some(f64::from(trace.messages) / end_s);
    figures.knots_per_s = Some(f64::from(trace.knots) / end_s);
    let Some(packets) = &trace.packets else {
        return;
    };
    let during = |up: bool| {
        let of = packets.iter().filter(move |p| p.up == up);
        of.filter(|p| (0.0..end_s).contains(&p.sent_s))
    };
    let rates = |up: bool| {
        let (packets, bytes) = during(up).fold((0, 0), |(n, b), p| (n + 1, b + p.bytes));
        (Some(f64::from(packets) / end_s), Some(bytes as f64 / end_s))
    };
    (figures.up_packets_per_s, figures.up_bytes_per_s) = rates(true);
    (figures.down_packets_per_s, figures.down_bytes_per_s) = rates(false);
    if let Some(passing) = Passing::of(during(true).map(|p| (p.sent_s, p.arrived_s))) {
        figures.delay_p50_s = Some(passing.delay_p50_s);
        figures.delay_p99_s = Some(passing.delay_p99_s);
        figures.variation_s = Some(passing.variation_s);
        figures.loss = Some(passing.loss);
        figures.reordered = Some(passing.reordered);
    }
}

/// What the operator predicts from each sample, without network and arm. Ours from each sample too, not only from those it
/// speaks of: it speaks when a prediction has failed, so that its messages are a choice of the hard moments.
fn prediction(
    figures: &mut Figures,
    settings: &Settings,
    subject: &Subject,
    d: &Demonstration,
    axes: Axes,
) {
    let end_s = d.last().t_s;
    let mut errors: [Vec<f64>; 4] = Default::default();
    let mut held = [0_u32; 4];
    let mut judge = |from_s: f64, from: Vector3<f64>, ahead: &dyn Fn(f64) -> Guess| {
        for (n, h_s) in HORIZONS_S.iter().enumerate() {
            if from_s + h_s <= end_s {
                let (guess, truth) = (ahead(*h_s), d.position_at(from_s + h_s) - from);
                errors[n].push((guess.way - truth).norm());
                let within = guess.distance2(&truth).is_some_and(|d2| d2 <= REGION_90);
                held[n] += u32::from(within);
            }
        }
    };
    match settings.method {
        Method::Ours => {
            // Here a sample is taken the moment it is valid.
            let config = SessionConfig {
                input_latency_s: 0.0,
                ..session(settings, axes)
            };
            let mut live = Live::of_every_sample(&subject.skill, config, 0.0);
            for sample in d.samples() {
                if let Some(said) = live.take(sample).pop() {
                    let since_s = said.place.t.secs_since(on_session_clock(0.0));
                    judge(since_s, said.place.x, &|h_s| {
                        Guess::of(&said.place.ahead, h_s)
                    });
                }
            }
        }
        Method::Hold | Method::Velocity(_) | Method::Kalman => {
            let mut sender = Sender::new(settings.method, &subject.kalman);
            for sample in d.samples() {
                if let Some(message) = sender.take(sample) {
                    let ahead = |h_s| message.hand(settings.method, h_s, 0.0, 0.0).place;
                    let from = sample.position;
                    judge(sample.t_s, from, &|h_s| (ahead(h_s) - from).into());
                }
            }
        }
        // They state no prediction.
        Method::Deadband(_) | Method::Playback | Method::Floor => return,
    }
    let rms_of = |n: usize| (!errors[n].is_empty()).then(|| rms(errors[n].iter().copied()));
    figures.predicted_33ms_m = rms_of(0);
    figures.predicted_100ms_m = rms_of(1);
    figures.predicted_200ms_m = rms_of(2);
    figures.predicted_300ms_m = rms_of(3);
    if settings.method == Method::Ours {
        let share =
            |n: usize| (!errors[n].is_empty()).then(|| f64::from(held[n]) / errors[n].len() as f64);
        figures.held_33ms = share(0);
        figures.held_100ms = share(1);
        figures.held_200ms = share(2);
        figures.held_300ms = share(3);
    }
}

fn outage(figures: &mut Figures, trace: &Trace, (from_s, to_s): (f64, f64), end_s: f64) {
    // What was sent before the outage may still come after it, and says nothing of the link's return; meanwhile nothing
    // leaves. Telemetry that knows no time yet is a new session's.
    let middle_s = 0.5 * (from_s + to_s);
    let anew = |&&(at_s, of_s): &&(f64, Option<f64>)| {
        at_s >= to_s && of_s.is_none_or(|of_s| of_s > middle_s)
    };
    let heard = trace.heard_s.iter().flatten().find(anew);
    figures.reconnect_s = heard.map(|(at_s, _)| at_s - to_s);
    if let Outcome::Stopped(at_s, _) = trace.outcome
        && (from_s..to_s + AFTER_S).contains(&at_s)
    {
        let since: Vec<_> = trace
            .ticks
            .iter()
            .filter(|t| (from_s..end_s).contains(&t.t_s))
            .collect();
        // At rest from the first moment on after which it moves no more.
        let (Some(first), Some(last)) = (since.first(), since.last()) else {
            return;
        };
        let still_m = STILL_M / trace.scale;
        let rest = since
            .iter()
            .rposition(|t| (t.tip_m - last.tip_m).norm() > still_m)
            .map_or(0, |i| i + 1);
        figures.stop_s = since.get(rest).map(|t| t.t_s - from_s);
        let way = since.iter().map(|t| (t.tip_m - first.tip_m).norm());
        figures.stop_m = way.max_by(f64::total_cmp);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trace(outcome: Outcome, tip: impl Fn(f64) -> f64) -> Trace {
        let tick = |i: i32| {
            let t_s = f64::from(i) * 1e-3;
            Tick {
                t_s,
                tip_m: Vector3::new(tip(t_s), 0.0, 0.0),
                turn: None,
                jerk_m_s3: 0.0,
                limited: false,
                follows: true,
                age_s: None,
            }
        };
        Trace {
            ticks: (0..5000).map(tick).collect(),
            packets: Some(Vec::new()),
            outcome,
            messages: 10,
            knots: 20,
            scale: 0.1,
            // The third was sent before the link was cut.
            heard_s: Some(vec![
                (0.5, Some(0.45)),
                (1.9, Some(1.85)),
                (3.05, Some(1.95)),
                (3.25, None),
            ]),
            cpu: None,
            simulated_s: 5.0,
        }
    }

    #[test]
    fn stop_and_reconnection_are_told_from_the_outage() {
        // It goes on at 1 m/s for 0.4 s after the link is cut at 2 s, and stops.
        let stopped = trace(Outcome::Stopped(2.3, "LeaseOver".into()), |t| t.min(2.4));
        let mut figures = Figures::default();
        outage(&mut figures, &stopped, (2.0, 3.0), 5.0);
        assert!((figures.stop_m.unwrap() - 0.4).abs() < 1e-9);
        assert!(
            (figures.stop_s.unwrap() - 0.4).abs() < 2e-3,
            "{:?}",
            figures.stop_s
        );
        assert!((figures.reconnect_s.unwrap() - 0.25).abs() < 1e-12);
        let mut figures = Figures::default();
        outage(
            &mut figures,
            &trace(Outcome::Followed, |t| t),
            (2.0, 3.0),
            5.0,
        );
        assert_eq!((figures.stop_s, figures.stop_m), (None, None));
        // It had stopped before, or stopped long after: for another reason.
        for at_s in [1.5, 4.5] {
            let mut figures = Figures::default();
            let other = trace(Outcome::Stopped(at_s, "Uncertain".into()), |t| t.min(at_s));
            outage(&mut figures, &other, (2.0, 3.0), 5.0);
            assert_eq!((figures.stop_s, figures.stop_m), (None, None));
        }
        // It goes 0.3 m on and comes back: it went 0.3 m.
        let mut figures = Figures::default();
        let back = trace(Outcome::Stopped(2.3, "LeaseOver".into()), |t| {
            0.3 - (t.clamp(2.0, 2.6) - 2.3).abs()
        });
        outage(&mut figures, &back, (2.0, 3.0), 5.0);
        assert!((figures.stop_m.unwrap() - 0.3).abs() < 1e-9);
    }

    #[test]
    fn what_is_on_the_wire_is_counted_while_the_recording_lasts() {
        let mut run = trace(Outcome::Followed, |t| t);
        let packet = |sent_s, up| super::super::trace::Packet {
            up,
            sent_s,
            bytes: 100,
            arrived_s: Some(sent_s + 0.1),
        };
        let packets = (-10..20).map(|i| packet(f64::from(i) * 0.5, i % 2 == 0));
        run.packets = Some(packets.collect());
        let mut figures = Figures::default();
        wire(&mut figures, &run, 5.0);
        assert_eq!(figures.up_packets_per_s, Some(1.0));
        assert_eq!(figures.down_bytes_per_s, Some(100.0));
        assert_eq!(
            (figures.messages_per_s, figures.knots_per_s),
            (Some(2.0), Some(4.0))
        );
        assert!((figures.delay_p50_s.unwrap() - 0.1).abs() < 1e-9);
    }
}
