//! The hand of each engagement, out of a recording that the operator daemon made.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use telemime_endpoint::recording::read::{ReadError, read};
use telemime_endpoint::recording::{Hand, OperatorState, Own};
use telemime_operator::demonstration::LEAST_SAMPLES;

/// Why nothing can be made of a recording.
#[derive(Debug, thiserror::Error)]
pub(super) enum RecordedError {
    /// It cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// Something else wrote it.
    #[error("{}: message {number} is no {schema}: {source}; it was not recorded by this version of telemime", path.display())]
    Message {
        /// The file.
        path: PathBuf,
        /// Which message, from 1 on.
        number: u64,
        /// What it should be.
        schema: &'static str,
        /// Why it is not.
        source: serde_json::Error,
    },
    /// There is no hand in it.
    #[error(
        "{}: nobody's hand is in this recording: the operator records it (telemime operator --record), the robot does not",
        path.display()
    )]
    NoHand {
        /// The file.
        path: PathBuf,
    },
    /// It never drove.
    #[error("{}: the hand was never followed for {LEAST_SAMPLES} samples or more, so there is nothing to learn from", path.display())]
    NeverDriven {
        /// The file.
        path: PathBuf,
    },
}

/// A table of what the hand did in one engagement.
pub(super) struct Engagement {
    /// What its demonstration is called after.
    pub(super) raw: PathBuf,
    /// `t,x,y,z[,qw,qx,qy,qz][,grip]`, s and m.
    pub(super) table: String,
}

/// Whatever was driven long enough to be learned from, in order; `say` is told what was not.
pub(super) fn engagements(
    path: &Path,
    say: impl Fn(String),
) -> Result<Vec<Engagement>, RecordedError> {
    let mut runs: Vec<Vec<Hand>> = Vec::new();
    let mut running = false;
    let mut granted = BTreeSet::new();
    let (mut number, mut heard, mut wrong) = (0, false, None);
    let contents = read(path, |message| {
        number += 1;
        let mut refuse = |schema, source| {
            let path = path.to_owned();
            wrong.get_or_insert(RecordedError::Message {
                path,
                number,
                schema,
                source,
            });
        };
        if message.schema == Hand::NAME {
            heard = true;
            match serde_json::from_slice::<Hand>(message.data) {
                Ok(hand) if hand.engagement == 0 => running = false,
                Ok(hand) if hand.resting => {}
                Ok(hand) => {
                    // A robot that was restarted counts from 1 again: the numbers alone do not tell engagements apart.
                    match runs.last_mut().filter(|run| running && follows(run, &hand)) {
                        Some(run) => run.push(hand),
                        None => runs.push(vec![hand]),
                    }
                    running = true;
                }
                Err(e) => refuse(Hand::NAME, e),
            }
        } else if message.schema == OperatorState::NAME {
            match serde_json::from_slice::<OperatorState>(message.data) {
                Ok(state) => drop(granted.insert((state.session, state.engagement))),
                Err(e) => refuse(OperatorState::NAME, e),
            }
        }
    })?;
    if let Some(wrong) = wrong {
        return Err(wrong);
    }
    let path = path.to_owned();
    if !heard {
        return Err(RecordedError::NoHand { path });
    }
    if !contents.complete {
        say(format!(
            "{} was cut off; what was written before is used",
            path.display()
        ));
    }
    runs.retain(|run| granted.contains(&number_of(run)));
    runs.retain(|run| {
        let long = run.len() >= LEAST_SAMPLES;
        if !long {
            say(format!(
                "{}: engagement {} of session {} is left out: {} samples are too few to learn from",
                path.display(),
                number_of(run).1,
                number_of(run).0,
                run.len()
            ));
        }
        long
    });
    if runs.is_empty() {
        return Err(RecordedError::NeverDriven { path });
    }
    let several = runs.len() > 1;
    let named = runs.iter().zip(1..).map(|(driven, number)| {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let raw = path.with_file_name(format!("{stem}-{number}.mcap"));
        Engagement {
            raw: if several { raw } else { path.clone() },
            table: table(driven),
        }
    });
    Ok(named.collect())
}

/// Session and engagement.
fn number_of(run: &[Hand]) -> (u32, u32) {
    run.last()
        .map_or((0, 0), |last| (last.session, last.engagement))
}

fn follows(run: &[Hand], hand: &Hand) -> bool {
    number_of(run) == (hand.session, hand.engagement)
        && run.last().is_none_or(|last| last.t_ns < hand.t_ns)
}

/// Columns that some sample lacks are left out.
fn table(driven: &[Hand]) -> String {
    let turned = driven.iter().all(|hand| hand.orientation.is_some());
    let gripped = driven.iter().all(|hand| hand.grip.is_some());
    let mut text = String::from("t,x,y,z");
    text += if turned { ",qw,qx,qy,qz" } else { "" };
    text += if gripped { ",grip\n" } else { "\n" };
    let zero_ns = driven.first().map_or(0, |hand| hand.t_ns);
    for hand in driven {
        let [x, y, z] = hand.x;
        let t_s = (hand.t_ns - zero_ns) as f64 * 1e-9;
        text += &format!("{t_s},{x},{y},{z}");
        let turn = hand.orientation.iter().flatten().filter(|_| turned);
        let more = turn.chain(hand.grip.iter().filter(|_| gripped));
        more.for_each(|v| text += &format!(",{v}"));
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use telemime_endpoint::recording::{At, Json, Recording, Tape, To};
    use telemime_protocol::time::Stamp;

    use super::*;

    fn hand(ms: i64, session: u32, engagement: u32) -> Hand {
        Hand {
            t_ns: ms * 1_000_000,
            x: [ms as f64 * 1e-3, 0.0, 0.0],
            orientation: None,
            grip: Some(0.25),
            resting: ms % 1000 < 100,
            session,
            engagement,
        }
    }

    fn state(session: u32, engagement: u32) -> OperatorState {
        OperatorState {
            robot: "Engaged".into(),
            cause: "Requested".into(),
            session,
            engagement,
            scale: None,
            messages: 0,
            knots: 0,
            samples: 0,
            glitches: 0,
            age_s: None,
            delay_s: None,
            clock_bound_s: None,
            lag_s: None,
            clamps: None,
            lost: None,
            knots_held: None,
        }
    }

    #[test]
    fn every_engagement_that_was_granted_is_a_table_of_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mon.day.mcap");
        let write = |tape: &mut Tape, hand: Hand| {
            let at = At::once(Stamp(hand.t_ns));
            if hand.engagement != 3 {
                let state = state(hand.session, hand.engagement);
                tape.message("/operator/state", at, &Json(state))?;
            }
            tape.message("/operator/hand", at, &Json(hand))
        };
        let to = To {
            file: Some(&path),
            live: None,
        };
        let recording = Recording::start(to, [].into(), write, |_| ()).unwrap();
        // Not followed; followed; declined; too short; followed; and after the robot's restart the same numbers again.
        let spans = [
            (0, 1, 0, 20),
            (1000, 1, 1, 40),
            (2000, 1, 3, 40),
            (3000, 1, 4, 12),
            (4000, 1, 5, 30),
            (5000, 1, 0, 5),
            (6000, 1, 5, 25),
        ];
        for (from_ms, session, engagement, count) in spans {
            for i in 0..count {
                recording.push(hand(from_ms + 20 * i, session, engagement));
            }
        }
        drop(recording);
        let said = RefCell::new(Vec::new());
        let all = engagements(&path, |note| said.borrow_mut().push(note)).unwrap();
        let names: Vec<_> = all
            .iter()
            .map(|one| one.raw.file_name().unwrap().to_str().unwrap())
            .collect();
        assert_eq!(
            names,
            ["mon.day-1.mcap", "mon.day-2.mcap", "mon.day-3.mcap"]
        );
        let rows: Vec<_> = all.iter().map(|one| one.table.lines().count()).collect();
        // Five of each span are at rest; the first line names the columns.
        assert_eq!(rows, [36, 26, 21]);
        let lines: Vec<_> = all[0].table.lines().collect();
        assert_eq!(lines[..2], ["t,x,y,z,grip", "0,1.1,0,0,0.25"]);
        assert_eq!(lines[35], "0.68,1.78,0,0,0.25");
        let said = said.into_inner();
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].contains("engagement 4") && said[0].contains("7 samples"));
    }
}
