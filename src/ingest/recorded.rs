//! The hand of each engagement, out of a recording that the operator daemon made.

use std::collections::{BTreeMap, BTreeSet};
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
    let mut hands: BTreeMap<(u32, u32), Vec<Hand>> = BTreeMap::new();
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
                Ok(hand) if hand.engagement > 0 && !hand.resting => {
                    let driven = hands.entry((hand.session, hand.engagement)).or_default();
                    if driven.last().is_none_or(|last| last.t_ns < hand.t_ns) {
                        driven.push(hand);
                    }
                }
                Ok(_) => {}
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
    hands.retain(|which, driven| granted.contains(which) && driven.len() >= LEAST_SAMPLES);
    if hands.is_empty() {
        return Err(RecordedError::NeverDriven { path });
    }
    let several = hands.len() > 1;
    let named = hands.into_values().zip(1..).map(|(driven, number)| {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let raw = path.with_file_name(format!("{stem}-{number}.mcap"));
        Engagement {
            raw: if several { raw } else { path.clone() },
            table: table(&driven),
        }
    });
    Ok(named.collect())
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
