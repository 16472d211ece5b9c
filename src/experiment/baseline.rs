//! What ours is held against: the same link, arm and filter, other information.

use nalgebra::Vector3;
use telemime_operator::cli::Axes;
use telemime_operator::session::{GO_S, default_scale};
use telemime_robot::rig::Rig;
use telemime_robot::servo::Mapping;
use telemime_sim::link::Link;

use super::drive::{driven, from_zero};
use super::factor::Settings;
use super::method::{HEADERS, Message, Method, Sender};
use super::subject::Subject;
use super::trace::{Outcome, Packet, Tick, Trace};
use crate::measure::{Hand, Track, Turns, follow};

/// The arm follows the resting hand for this long before the recording begins, s.
const REST_S: f64 = 1.0;

/// A plan travels in packets of this many bytes.
const PLAN_PACKET: usize = 1100;

/// What a go is on the wire, bytes, headers included: epoch, number, engagement, lease.
const GO_BYTES: usize = 12 + HEADERS;

/// One direction, with its outage; what it carried is kept.
struct Path<'a> {
    link: Link,
    settings: &'a Settings,
    packets: Vec<Packet>,
}

impl Path<'_> {
    fn send(&mut self, at_s: f64, bytes: usize) -> Option<f64> {
        let fate = self.link.send((at_s * 1e9).round() as i64, bytes);
        let cut = |(from_s, to_s)| (from_s..to_s).contains(&at_s);
        let arrived_s = match fate.arrival_ns() {
            Some(at_ns) if !self.settings.outage_s.is_some_and(cut) => Some(at_ns as f64 * 1e-9),
            _ => None,
        };
        self.packets.push(Packet {
            up: true,
            sent_s: at_s,
            bytes,
            arrived_s,
        });
        arrived_s
    }
}

/// Drives the arm through one recording by a baseline.
pub(super) fn drive(
    settings: &Settings,
    subject: &Subject,
    rig: &Rig,
    axes: Axes,
    seed: u64,
) -> Trace {
    let samples = from_zero(driven(settings, subject));
    let (first, end_s) = (samples[0], samples[samples.len() - 1].t_s);
    let truth = Track::new(samples.iter().map(|s| (s.t_s, s.position)).collect())
        .expect("a demonstration is in order and finite");
    let turns = samples.iter().map(|s| Some((s.t_s, s.orientation?)));
    let turns = turns.collect::<Option<Vec<_>>>().and_then(Turns::new);
    let derived = default_scale(subject.skill.stats(), &rig.info());
    let mapping = Mapping {
        scale: settings.scale.unwrap_or(derived),
        rotation: axes.rotation(),
        hand_m: first.position,
        tip_m: Vector3::zeros(),
        hand_orientation: first.orientation,
        tip_orientation: Default::default(),
    };
    let lag_s = rig.lag_s();
    let mut link = Link::new(settings.up.clone(), seed);
    link.begin_at(0);
    let mut path = Path {
        link,
        settings,
        packets: Vec::new(),
    };
    let (mut messages, mut knots) = (0, 0);
    let mut ages = Vec::new();
    let followed = match settings.method {
        Method::Floor => follow(rig, &mapping, -REST_S, end_s, |t| {
            Some(Hand {
                place: truth.at(t + lag_s),
                turn: turns.as_ref().map(|turns| turns.at(t + lag_s)),
            })
        }),
        Method::Playback => {
            let (curve, bytes, points) = &subject.played;
            knots = *points as u32;
            for part in 0..bytes.div_ceil(PLAN_PACKET) {
                let left = bytes - part * PLAN_PACKET;
                path.send(-REST_S, left.min(PLAN_PACKET) + HEADERS);
            }
            // Repeated as ours is, until one arrives.
            let gos = (0..).map(|n| settings.input_latency_s + f64::from(n) * GO_S);
            let mut begin_s = f64::INFINITY;
            for at_s in gos.take_while(|at_s| *at_s < end_s) {
                messages += 1;
                if let Some(arrived_s) = path.send(at_s, GO_BYTES) {
                    begin_s = arrived_s;
                    break;
                }
            }
            follow(rig, &mapping, -REST_S, end_s, |t| {
                let plan_s = (t - begin_s + lag_s).clamp(0.0, curve.end_s());
                Some(Hand {
                    place: curve.position_at(plan_s),
                    turn: first
                        .orientation
                        .and_then(|q| curve.orientation_at(plan_s).or(Some(q))),
                })
            })
        }
        method => {
            let mut sender = Sender::new(method, &subject.kalman);
            let mut arrivals: Vec<(f64, f64, Message)> = Vec::new();
            for sample in &samples {
                let Some(message) = sender.take(sample) else {
                    continue;
                };
                messages += 1;
                let sent_s = sample.t_s + settings.input_latency_s;
                if let Some(at_s) = path.send(sent_s, message.bytes) {
                    arrivals.push((at_s, at_s - sample.t_s, message));
                }
            }
            arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut waiting = arrivals.into_iter().peekable();
            let mut newest: Option<(f64, Message)> = None;
            follow(rig, &mapping, -REST_S, end_s, |t| {
                while let Some((_, late_s, message)) = waiting.next_if(|(at_s, ..)| *at_s <= t) {
                    // What was overtaken says nothing.
                    if newest.is_none_or(|(_, held)| held.t_s < message.t_s) {
                        newest = Some((late_s, message));
                    }
                }
                ages.push(newest.map(|(_, message)| t - message.t_s));
                let (late_s, message) = newest?;
                Some(message.hand(method, t - message.t_s, late_s, lag_s))
            })
        }
    };
    // One of each a tick; floor and play-back know no age.
    let ages = ages.into_iter().chain(std::iter::repeat(None));
    let points = followed.tip.points().iter().zip(&followed.strain);
    let ticks = points
        .zip(ages)
        .map(|(((t_s, tip_m), (limited, jerk_m_s3)), age_s)| Tick {
            t_s: *t_s,
            tip_m: *tip_m,
            turn: followed.turn.as_ref().map(|turn| turn.at(*t_s)),
            jerk_m_s3: *jerk_m_s3,
            limited: *limited,
            follows: true,
            age_s,
        });
    Trace {
        ticks: ticks.collect(),
        packets: Some(path.packets),
        outcome: Outcome::Followed,
        messages,
        knots,
        scale: mapping.scale,
        heard_s: None,
        cpu: None,
        simulated_s: end_s + REST_S,
    }
}
