//! Who is driven: a person's skill, a performance of it that was never learned from, and another motion.

use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;
use telemime_operator::cli::{Bounds, infer};
use telemime_operator::demonstration::{Demonstration, DemonstrationError, Demonstrations, Sample};
use telemime_operator::learn::{LearnError, LearnOptions, learn_skill};
use telemime_protocol::checkpoint::{PoseCurve, PosePlan};
use telemime_protocol::skill::Skill;
use telemime_protocol::wire::codec;
use telemime_sim::hand::swing_with_wrist;

use super::plan::{Motion, Plan};
use crate::evaluate::Kalman;

/// Other people than those who are learned from chop.
const CHOP_STREAM: u64 = 0x00c4_0b00;

/// One person with one skill.
pub(super) struct Subject {
    /// As the results name it.
    pub(super) name: String,
    /// The bootstrap draws people.
    pub(super) person: String,
    pub(super) skill: Arc<Skill>,
    /// Tuned on what the skill was learned from.
    pub(super) kalman: Kalman,
    /// The skill's inferred motion, as it is sent and rebuilt, and its bytes.
    pub(super) played: (PoseCurve, usize, usize),
    /// A performance that was not learned from.
    pub(super) on_model: Demonstration,
    /// Another motion.
    pub(super) off_model: Demonstration,
}

/// Why there is nobody to drive.
#[derive(Debug, thiserror::Error)]
pub(super) enum SubjectError {
    #[error(transparent)]
    Read(#[from] DemonstrationError),
    #[error("{folder}: two folders are called {name}; rename one")]
    Alike { folder: String, name: String },
    #[error(
        "{folder}: nobody in it performed twice, as {pattern} finds persons in the file names: one recording to learn from and one to drive are needed"
    )]
    Once { folder: String, pattern: String },
    #[error("{name}: {source}")]
    Learn { name: String, source: LearnError },
    #[error("{name}: its motion cannot be compressed: {why}")]
    Play { name: String, why: String },
}

/// What a subject is made of.
pub(super) struct Material {
    name: String,
    person: String,
    learn: Vec<Demonstration>,
    on_model: Demonstration,
    off_model: Demonstration,
}

/// Everybody the plan drives, in order.
pub(super) fn materials(plan: &Plan) -> Result<Vec<Material>, SubjectError> {
    let mut materials = if plan.motion.folders.is_empty() {
        generated(plan)?
    } else {
        recorded(&plan.motion, plan.seed)?
    };
    if let Some(most) = plan.motion.most {
        let mut people: Vec<String> = Vec::new();
        materials.retain(|material| {
            if people.contains(&material.person) {
                return true;
            }
            let one_more = people.len() < most;
            if one_more {
                people.push(material.person.clone());
            }
            one_more
        });
    }
    Ok(materials)
}

/// Learns their skills; `progress` hears of each, from any thread.
pub(super) fn subjects(
    materials: Vec<Material>,
    seed: u64,
    progress: impl Fn() + Sync,
) -> Result<Vec<Subject>, SubjectError> {
    materials
        .into_par_iter()
        .map(|material| {
            let subject = learn(material, seed);
            progress();
            subject
        })
        .collect()
}

fn learn(material: Material, seed: u64) -> Result<Subject, SubjectError> {
    let Material {
        name,
        person,
        learn,
        on_model,
        off_model,
    } = material;
    let options = LearnOptions {
        seed,
        ..LearnOptions::default()
    };
    let skill = learn_skill(&name, &learn, &options, |_| ()).map_err(|source| {
        let name = name.clone();
        SubjectError::Learn { name, source }
    })?;
    let played = play(&skill).map_err(|e| SubjectError::Play {
        name: name.clone(),
        why: format!("{e:#}"),
    })?;
    Ok(Subject {
        kalman: Kalman::tuned(&learn),
        skill: Arc::new(skill),
        name,
        person,
        played,
        on_model,
        off_model,
    })
}

fn play(skill: &Skill) -> anyhow::Result<(PoseCurve, usize, usize)> {
    let (plan, report) = infer(skill, Bounds::of(skill), &[])?;
    let bytes = codec::encode::<PosePlan>(&plan).len();
    Ok((plan.curve()?, bytes, report.checkpoints))
}

/// People who swing an arm; off the model they chop.
fn generated(plan: &Plan) -> Result<Vec<Material>, SubjectError> {
    let motion = &plan.motion;
    let person = |n: u64| {
        // The plan's seed chooses the people.
        let seed = plan.seed.wrapping_mul(1000).wrapping_add(n);
        let perform = |index| made(&format!("{index}.csv"), seed, index, motion.wrist, false);
        Ok(Material {
            name: format!("swing of person {seed}"),
            person: seed.to_string(),
            learn: (0..motion.performances)
                .map(perform)
                .collect::<Result<_, _>>()?,
            on_model: perform(motion.performances)?,
            off_model: chop(seed, motion.wrist)?,
        })
    };
    (1..=motion.people).map(person).collect()
}

fn chop(seed: u64, wrist: bool) -> Result<Demonstration, SubjectError> {
    made("chop.csv", seed ^ CHOP_STREAM, 0, wrist, true)
}

/// A performance of `sim::hand`; turned by a right angle about the sensor's axis a wave is a chop: as fast, and in a plane
/// and at places that nobody has shown.
fn made(
    name: &str,
    seed: u64,
    index: u32,
    wrist: bool,
    turned: bool,
) -> Result<Demonstration, SubjectError> {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let poses = swing_with_wrist(seed, index);
    let samples: Vec<_> = poses
        .into_iter()
        .map(|pose| {
            let [w, x, y, z] = pose.q;
            let q = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let (x, q) = if turned {
                (turn * Vector3::from(pose.x), turn * q)
            } else {
                (Vector3::from(pose.x), q)
            };
            Sample {
                orientation: wrist.then_some(q),
                ..Sample::at(pose.t_s, x)
            }
        })
        .collect();
    Ok(Demonstration::from_samples(name, &samples)?)
}

/// Each person of each folder: the last recording is driven, or each; of the others the first are learned from.
fn recorded(motion: &Motion, seed: u64) -> Result<Vec<Material>, SubjectError> {
    let read = |dirs: &[std::path::PathBuf], matching: Option<&str>| {
        dirs.iter()
            .map(|dir| Demonstrations::read_dir(dir, matching))
            .collect::<Result<Vec<_>, _>>()
    };
    let sets = read(&motion.folders, motion.matching.as_deref())?;
    let others = read(&motion.off_model, None)?;
    for notice in sets.iter().chain(&others).flat_map(|set| &set.notices) {
        eprintln!("note: {notice}");
    }
    for (n, set) in sets.iter().enumerate() {
        if sets[..n].iter().any(|other| other.name == set.name) {
            return Err(SubjectError::Alike {
                folder: motion.folders[n].display().to_string(),
                name: set.name.clone(),
            });
        }
    }
    let mut all = Vec::new();
    for (n, set) in sets.iter().enumerate() {
        let mut people: Vec<(&str, Vec<&Demonstration>)> = Vec::new();
        for (m, d) in set.demonstrations.iter().enumerate() {
            // A copy would be learned from where the other is driven.
            let before = &set.demonstrations[..m];
            if before.iter().any(|other| other.sha256() == d.sha256()) {
                continue;
            }
            let who = motion.persons.person(d);
            match people.iter_mut().find(|(w, _)| *w == who) {
                Some((_, of)) => of.push(d),
                None => people.push((who, vec![d])),
            }
        }
        people.retain(|(_, of)| of.len() > 1);
        if people.is_empty() {
            return Err(SubjectError::Once {
                folder: set.name.clone(),
                pattern: motion.persons.to_string(),
            });
        }
        let driven = |(who, of): (&'_ str, Vec<&'_ Demonstration>)| {
            let first = if motion.every { 0 } else { of.len() - 1 };
            (first..of.len())
                .map(|n| {
                    let others = of.iter().enumerate().filter(|(m, _)| *m != n);
                    let learn: Vec<_> = others
                        .map(|(_, d)| (*d).clone())
                        .take(motion.learn_from)
                        .collect();
                    (who.to_owned(), of[n].clone(), learn)
                })
                .collect::<Vec<_>>()
        };
        for (who, driven, learn) in people.into_iter().flat_map(driven) {
            // The same person with another motion, if there is one; then anybody; then a generated one.
            let rest = sets.iter().enumerate().filter(|(other, _)| *other != n);
            let strange: Vec<_> = others
                .iter()
                .chain(rest.map(|(_, set)| set))
                .flat_map(|set| &set.demonstrations)
                .filter(|d| {
                    set.demonstrations
                        .iter()
                        .all(|own| own.sha256() != d.sha256())
                })
                .collect();
            let own = strange
                .iter()
                .find(|d| motion.persons.person(d) == who.as_str());
            let off_model = match own.or(strange.first()) {
                Some(d) => (*d).clone(),
                None => chop(seed, driven.has_orientation())?,
            };
            let name = format!("{} by {who}", set.name);
            all.push(Material {
                name: if motion.every {
                    format!("{name}, {}", driven.name())
                } else {
                    name
                },
                person: who,
                learn,
                on_model: driven,
                off_model,
            });
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn what_is_driven_was_not_learned_from_and_seeds_make_people() {
        let plan = |seed: u64| {
            let text =
                format!("seed = {seed}\n[motion]\npeople = 2\nperformances = 2\nwrist = true\n");
            Plan::parse("a", &text, Path::new(".")).unwrap()
        };
        let people = generated(&plan(4)).unwrap();
        assert_eq!(people.len(), 2);
        for m in &people {
            let known = |d: &Demonstration| m.learn.iter().any(|l| l.sha256() == d.sha256());
            assert!(!known(&m.on_model) && !known(&m.off_model));
            assert!(m.on_model.has_orientation() && m.off_model.has_orientation());
        }
        let again = generated(&plan(4)).unwrap();
        assert_eq!(people[1].on_model.sha256(), again[1].on_model.sha256());
        let other = generated(&plan(5)).unwrap();
        assert_ne!(people[1].on_model.sha256(), other[1].on_model.sha256());
    }

    #[test]
    fn of_recordings_the_last_is_driven_or_each_and_never_learned_from() {
        let dir = tempfile::tempdir().unwrap();
        let plan = |every: bool| {
            let text = format!("[motion]\nfolders = [\"wave\"]\nlearn_from = 2\nevery = {every}\n");
            Plan::parse("a", &text, dir.path()).unwrap()
        };
        let folder = dir.path().join("wave");
        std::fs::create_dir(&folder).unwrap();
        for index in 0..4 {
            let d = made("x", 7, index, false, false).unwrap();
            std::fs::write(folder.join(format!("{index}.csv")), d.to_csv()).unwrap();
        }
        let last = recorded(&plan(false).motion, 1).unwrap();
        assert_eq!(last.len(), 1);
        assert_eq!(last[0].learn.len(), 2);
        let every = recorded(&plan(true).motion, 1).unwrap();
        assert_eq!(every.len(), 4);
        for (n, m) in every.iter().enumerate() {
            assert!(
                m.learn.iter().all(|l| l.sha256() != m.on_model.sha256()),
                "{n}"
            );
            assert_eq!((m.learn.len(), &m.person), (2, &every[0].person));
            assert!(
                every[..n].iter().all(|before| before.name != m.name),
                "{}",
                m.name
            );
        }
        assert_eq!(every[3].on_model.sha256(), last[0].on_model.sha256());
        assert_eq!(every[3].learn[0].sha256(), last[0].learn[0].sha256());
    }

    #[test]
    fn a_copy_of_what_is_driven_is_not_learned_from_and_folders_have_names_of_their_own() {
        let dir = tempfile::tempdir().unwrap();
        let place = |folder: &str, index: u32, name: &str| {
            let folder = dir.path().join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            let d = made("x", 7, index, false, false).unwrap();
            std::fs::write(folder.join(name), d.to_csv()).unwrap();
        };
        for (index, name) in [
            (0, "s1_0"),
            (1, "s1_1"),
            (2, "s1_2"),
            (1, "s1_3"),
            (3, "s2_0"),
            (4, "s2_1"),
        ] {
            place("a/wave", index, &format!("{name}.csv"));
            place("b/wave", index, &format!("{name}.csv"));
        }
        let plan = |motion: &str| {
            let text = format!("[motion]\n{motion}\n");
            Plan::parse("a", &text, dir.path()).unwrap()
        };
        let all = materials(&plan(
            "folders = [\"a/wave\"]\nevery = true\ngroup_by = \"{}_*\"",
        ))
        .unwrap();
        assert_eq!(all.len(), 5, "each once");
        for m in &all {
            assert!(m.learn.iter().all(|l| l.sha256() != m.on_model.sha256()));
        }
        let mut one = plan("folders = [\"a/wave\"]\nevery = true\ngroup_by = \"{}_*\"");
        one.motion.most = Some(1);
        let first = materials(&one).unwrap();
        assert!(first.len() == 3 && first.iter().all(|m| m.person == "s1"));
        let alike = materials(&plan("folders = [\"a/wave\", \"b/wave\"]"));
        assert!(matches!(alike, Err(SubjectError::Alike { .. })));
    }
}
