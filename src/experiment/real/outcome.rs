//! What two processes leave behind, as a run of any ground.
//!
//! Both and the relay share the host's monotonic clock, which is the common clock here; the robot's estimate of the
//! session clock is never used to judge, but for the age that the robot itself states.

use telemime_operator::cli::Event as Operator;
use telemime_robot::cli::Event as Robot;

use super::super::drive::{UNREACHED, driven};
use super::super::factor::Settings;
use super::super::subject::Subject;
use super::super::trace::{Outcome, Packet, Tick, Trace};
use super::daemons::Left;
use crate::measure::{Track, Turns};
use crate::relay::{Fate, Passage};
use crate::ticks;

/// Ticks of a run are told every millisecond of the recording, whenever the servo's own were.
const GRID_S: f64 = 1e-3;

pub(super) fn trace(settings: &Settings, subject: &Subject, left: Left) -> anyhow::Result<Trace> {
    let done = left.operator.iter().find_map(|e| match e {
        Operator::Done {
            why,
            zero_mono_ns,
            messages,
            messages_at_rest,
            knots,
            knots_at_rest,
            ..
        } => Some((
            why.clone(),
            *zero_mono_ns,
            messages - messages_at_rest,
            knots - knots_at_rest,
        )),
        _ => None,
    });
    // It has dialled, or this would be an error.
    let unreached = || (Some(UNREACHED.to_owned()), None, 0, 0);
    let (why, zero_ns, messages, knots) = done.unwrap_or_else(unreached);
    let why = why.unwrap_or_else(|| "no reason given".to_owned());
    let mut trace = Trace {
        ticks: Vec::new(),
        packets: None,
        outcome: Outcome::NotDriven(why),
        messages,
        knots,
        scale: f64::NAN,
        heard_s: None,
        cpu: left.cpu,
        simulated_s: left.took_s,
    };
    let Some(zero_ns) = zero_ns else {
        return Ok(trace);
    };
    let time_s = |ns: i64| (ns - zero_ns) as f64 * 1e-9;
    trace.packets = left.passages.map(|passages| packets(&passages, time_s));
    let Some((mapping, engaged_ns)) = ticks::engagement(&left.robot) else {
        return Ok(trace);
    };
    trace.scale = mapping.scale;
    let samples = driven(settings, subject).samples();
    let end_s = samples[samples.len() - 1].t_s - samples[0].t_s;
    let record = ticks::read(&left.ticks)?;
    let tip = record.iter();
    let tip = tip.map(|t| (time_s(t.mono_ns), mapping.unplace(t.tip_m)));
    let tip = Track::new(tip.collect())?;
    let turned = record.iter();
    let turned = turned.map(|t| Some((time_s(t.mono_ns), mapping.unorient(&t.tip_q)?)));
    let turn = turned.collect::<Option<Vec<_>>>().and_then(Turns::new);
    trace.ticks = (0..(end_s / GRID_S).ceil() as u32)
        .map(|n| f64::from(n) * GRID_S)
        .filter_map(|t_s| {
            let newest = record.partition_point(|r| time_s(r.mono_ns) <= t_s);
            let newest = newest.checked_sub(1)?;
            let now = &record[newest];
            let before = newest.checked_sub(1).map_or(0, |n| record[n].clamps);
            Some(Tick {
                t_s,
                tip_m: tip.at(t_s),
                turn: turn.as_ref().map(|turn| turn.at(t_s)),
                jerk_m_s3: now.jerk_m_s3,
                limited: now.clamps > before,
                follows: now.follows,
                age_s: now.follows.then_some(now.age_s),
            })
        })
        .collect();
    let ended = record
        .iter()
        .find(|t| t.mono_ns >= engaged_ns && !t.follows);
    let cause = left.robot.iter().find_map(|e| match e {
        Robot::State {
            state,
            cause,
            mono_ns,
        } if *mono_ns >= engaged_ns && state != "Engaged" && state != "Coasting" => {
            Some(cause.clone())
        }
        _ => None,
    });
    trace.outcome = match ended.map(|t| time_s(t.mono_ns)) {
        Some(at_s) if at_s < end_s => Outcome::Stopped(at_s, cause.unwrap_or_default()),
        _ => Outcome::Followed,
    };
    Ok(trace)
}

/// As the relay saw them, in the order they came to it; a packet and its duplicate are one.
fn packets(passages: &[Passage], time_s: impl Fn(i64) -> f64) -> Vec<Packet> {
    let mut sorted: Vec<_> = passages.iter().collect();
    sorted.sort_by_key(|p| (p.at, p.up, p.copy));
    let mut packets: Vec<Packet> = Vec::new();
    for p in sorted {
        // What arrives with a bit flipped is as good as lost.
        let whole = p.out.filter(|_| p.fate != Fate::Corrupted);
        let arrived_s = whole.map(|out| time_s(out.0));
        match packets.last_mut() {
            Some(last) if p.copy => {
                let both = [last.arrived_s, arrived_s].into_iter().flatten();
                last.arrived_s = both.min_by(f64::total_cmp);
            }
            _ => packets.push(Packet {
                up: p.up,
                sent_s: time_s(p.at.0),
                bytes: p.len_bytes,
                arrived_s,
            }),
        }
    }
    packets
}

#[cfg(test)]
mod tests {
    use telemime_endpoint::Mono;

    use super::*;

    #[test]
    fn a_packet_and_its_duplicate_are_one_and_a_broken_one_is_lost() {
        let passage = |at, up, out: Option<i64>, fate, copy| Passage {
            at: Mono(at),
            up,
            len_bytes: 100,
            out: out.map(Mono),
            fate,
            copy,
        };
        // As a relay tells them: when their fate is done.
        let all = [
            passage(2, true, None, Fate::Lost, false),
            passage(1, true, Some(4), Fate::Passed, true),
            passage(3, false, Some(6), Fate::Corrupted, false),
            passage(1, true, Some(9), Fate::Passed, false),
        ];
        let seen: Vec<_> = packets(&all, |ns| ns as f64)
            .iter()
            .map(|p| (p.up, p.sent_s, p.arrived_s))
            .collect();
        assert_eq!(
            seen,
            [
                (true, 1.0, Some(4.0)),
                (true, 2.0, None),
                (false, 3.0, None)
            ]
        );
    }
}
