use std::f64::consts::{PI, TAU};
use std::sync::OnceLock;

use nalgebra::Vector3;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::predict::HandState;
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;

use super::trial::{self, Split, TrialError, TrialOptions};
use super::*;
use crate::demonstration::{Demonstration, Demonstrations, PersonPattern, Sample};
use crate::learn::predictor::states;
use crate::learn::{LearnOptions, PredictorOptions, learn_skill};

/// How long the hand rests before and after a gesture, s.
const REST_S: f64 = 0.4;

/// A gesture drawn with a phase that starts and stops smoothly, never twice alike, sampled at `rate_hz`.
pub(crate) fn perform(gesture: &str, seed: u64, rate_hz: f64) -> (f64, Vec<Sample>) {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut about = |v: f64, share: f64| v * (1.0 + rng.random_range(-share..share));
    let (size, duration_s) = (about(0.3, 0.1), about(2.0, 0.12));
    let lean = about(0.3, 0.2);
    let at = |u: f64| {
        let there_and_back = (PI * u).sin();
        match gesture {
            "circle" => Vector3::new((TAU * u).sin(), 1.0 - (TAU * u).cos(), 0.0) * size,
            "push" => Vector3::new(0.0, lean * there_and_back, -1.5 * there_and_back) * size,
            "wipe" => Vector3::new((3.0 * TAU * u).sin(), 2.0 * there_and_back, 0.0) * size,
            "chop" => Vector3::new(0.0, 0.5 * (4.0 * PI * u).sin(), 1.2 * u) * size,
            other => panic!("no gesture {other}"),
        }
    };
    let mut samples = Vec::new();
    let mut shake = Xoshiro256PlusPlus::seed_from_u64(!seed);
    let whole_s = duration_s + 2.0 * REST_S;
    for i in 0..=(whole_s * rate_hz) as usize {
        let t_s = i as f64 / rate_hz;
        let s = ((t_s - REST_S) / duration_s).clamp(0.0, 1.0);
        let noise = Vector3::from_fn(|_, _| shake.random_range(-2e-3..2e-3));
        // Smoothstep: from rest to rest.
        let position = at(s * s * (3.0 - 2.0 * s)) + Vector3::new(0.2, -0.3, 2.6) + noise;
        samples.push(Sample::at(t_s, position));
    }
    (duration_s, samples)
}

fn demonstration(gesture: &str, seed: u64) -> Demonstration {
    let name = format!("{gesture}_s1_t{seed}");
    Demonstration::from_samples(name, &perform(gesture, seed, 30.0).1).unwrap()
}

fn quick() -> LearnOptions {
    LearnOptions {
        // Two for each turn of the motion with most turns, and the rests.
        motion_components: 10..=10,
        predictor: PredictorOptions {
            folds: 4,
            ..PredictorOptions::default()
        },
        ..LearnOptions::default()
    }
}

/// Three skills, each learned from four performances (seeds 0 to 3).
pub(crate) fn skills() -> &'static [Skill] {
    static SKILLS: OnceLock<Vec<Skill>> = OnceLock::new();
    SKILLS.get_or_init(|| {
        ["circle", "push", "wipe"]
            .map(|gesture| {
                let some: Vec<_> = (0..4).map(|seed| demonstration(gesture, seed)).collect();
                learn_skill(gesture, &some, &quick(), |_| ()).unwrap()
            })
            .into()
    })
}

fn recogniser(options: RecogniseOptions) -> Recogniser {
    Recogniser::new(skills(), options).unwrap()
}

fn watch(recogniser: &mut Recogniser, d: &Demonstration) -> Vec<Recognition> {
    recogniser.reset();
    states(d)
        .map(|state| recogniser.take(&state).unwrap())
        .collect()
}

fn moved(d: &Demonstration, by: Vector3<f64>) -> Demonstration {
    let samples: Vec<_> = d
        .samples()
        .iter()
        .map(|s| Sample {
            position: s.position + by,
            ..*s
        })
        .collect();
    Demonstration::from_samples("moved", &samples).unwrap()
}

/// The share of answers, while the gesture is under way, with this verdict.
fn share(answers: &[Recognition], verdict: Verdict) -> f64 {
    let under_way = &answers[(30.0 * (REST_S + 0.7)) as usize..answers.len() - 24];
    let of = under_way.iter().filter(|r| r.verdict == verdict).count();
    of as f64 / under_way.len() as f64
}

#[test]
fn a_new_performance_is_recognised_and_followed() {
    let mut r = recogniser(RecogniseOptions::default());
    assert_eq!(r.names(), ["circle", "push", "wipe"]);
    for (i, gesture) in ["circle", "push", "wipe"].into_iter().enumerate() {
        for seed in 10..13 {
            let (duration_s, _) = perform(gesture, seed, 30.0);
            let d = demonstration(gesture, seed);
            let answers = watch(&mut r, &d);
            let right = share(&answers, Verdict::Skill(i));
            assert!(right > 0.9, "{gesture} {seed}: {right}");
            let whole_s = duration_s + 2.0 * REST_S;
            for share in [0.35, 0.5, 0.65] {
                let at = answers[(share * whole_s * 30.0) as usize];
                let off = (at.phase - share).abs();
                assert!(off < 0.1, "{gesture} {seed} at {share}: {}", at.phase);
                assert!(at.probability > 0.5, "{gesture} {seed}: {at:?}");
            }
            let ends = [answers[0].verdict, answers[answers.len() / 2].verdict];
            assert_eq!(ends, [Verdict::Resting, Verdict::Skill(i)]);
        }
    }
}

#[test]
fn what_was_never_shown_is_none_of_these() {
    let mut r = recogniser(RecogniseOptions::default());
    for seed in 20..24 {
        let answers = watch(&mut r, &demonstration("chop", seed));
        let refused = share(&answers, Verdict::Unknown);
        assert!(refused > 0.9, "{seed}: {refused}");
        assert!(answers[45].none > 0.5, "{:?}", answers[45]);
    }
    // The same hand doing something known is not refused.
    let known = watch(&mut r, &demonstration("circle", 20));
    assert!(share(&known, Verdict::Unknown) < 0.1);
}

#[test]
fn who_knows_nothing_recognises_nothing() {
    let mut r = Recogniser::new([], RecogniseOptions::default()).unwrap();
    let answers = watch(&mut r, &demonstration("push", 1));
    assert_eq!(answers[3].verdict, Verdict::Resting);
    assert!(share(&answers, Verdict::Unknown) > 0.99);
    let at = answers[40];
    assert_eq!((at.best, at.none, at.probability), (None, 1.0, 0.0));
    assert_eq!(r.probabilities().len(), 0);
}

#[test]
fn probabilities_and_none_are_all_there_is() {
    let mut r = recogniser(RecogniseOptions::default());
    for gesture in ["wipe", "chop"] {
        for state in states(&demonstration(gesture, 31)) {
            let answer = r.take(&state).unwrap();
            let all: f64 = r.probabilities().sum::<f64>() + answer.none;
            assert!((all - 1.0).abs() < 1e-12, "{all}");
            let most = r.probabilities().fold(0.0, f64::max);
            assert!((answer.probability - most).abs() < 1e-12);
        }
        r.reset();
    }
}

#[test]
fn place_matters_as_much_as_it_is_told_to() {
    let d = demonstration("circle", 40);
    let verdicts = |place_sd_m: f64, by_m: f64| {
        let mut r = recogniser(RecogniseOptions {
            place_sd_m,
            ..RecogniseOptions::default()
        });
        let answers = watch(&mut r, &moved(&d, Vector3::new(by_m, 0.0, 0.0)));
        share(&answers, Verdict::Skill(0))
    };
    assert!(verdicts(0.1, 0.05) > 0.9);
    assert!(verdicts(0.2, 0.1) > 0.9);
    assert!(verdicts(0.1, 1.0) < 0.1);
    assert!(verdicts(0.0, 0.1) < 0.1);
    assert!(verdicts(f64::INFINITY, 0.0) > 0.9);
    // Another place is the same to the last bit but rounding: nothing else may depend on it.
    assert_eq!(verdicts(f64::INFINITY, 5.0), verdicts(f64::INFINITY, 0.0));
}

#[test]
fn a_faster_sensor_sees_the_same() {
    let mut r = recogniser(RecogniseOptions::default());
    let slow = watch(&mut r, &demonstration("wipe", 50));
    let samples = perform("wipe", 50, 120.0).1;
    let fast = watch(
        &mut r,
        &Demonstration::from_samples("fast", &samples).unwrap(),
    );
    for second in [1.2, 1.6, 2.0] {
        let (a, b) = (
            slow[(30.0 * second) as usize],
            fast[(120.0 * second) as usize],
        );
        assert!((a.phase - b.phase).abs() < 0.05, "{second}: {a:?} {b:?}");
        assert!(
            (a.novelty - b.novelty).abs() < 0.15,
            "{second}: {a:?} {b:?}"
        );
    }
    // Where the novelty touches the limit, the sensors' noise decides.
    let under_way = 20..80;
    let alike = under_way
        .clone()
        .filter(|&i| slow[i].verdict == fast[4 * i].verdict);
    assert!(alike.count() as f64 > 0.95 * under_way.len() as f64);
}

#[test]
fn the_same_hand_gives_the_same_bits() {
    let d = demonstration("push", 60);
    let once = watch(&mut recogniser(RecogniseOptions::default()), &d);
    let mut r = recogniser(RecogniseOptions::default());
    watch(&mut r, &demonstration("chop", 61));
    // What was seen before a reset leaves no trace.
    assert_eq!(watch(&mut r, &d), once);
}

#[test]
fn bad_states_change_nothing_and_a_hole_begins_anew() {
    let mut r = recogniser(RecogniseOptions::default());
    let mut nan = HandState::first(Stamp(0), Vector3::zeros());
    nan.x.y = f64::NAN;
    assert_eq!(r.take(&nan), None);
    let all: Vec<_> = states(&demonstration("circle", 70)).collect();
    let mut last = None;
    for state in &all[..40] {
        last = r.take(state);
    }
    nan.t = Stamp(i64::MAX / 2);
    assert_eq!(r.take(&nan), last);
    assert_eq!(r.take(&all[39]), last);
    assert_eq!(r.take(&all[20]), last);
    let before: Vec<_> = r.probabilities().collect();
    assert!(before[0] > 0.9, "{before:?}");

    let mut later = all[40];
    later.t = Stamp(all[39].t.0 + 1_500_000_000);
    let answer = r.take(&later).unwrap();
    let mut fresh = recogniser(RecogniseOptions::default());
    assert_eq!(fresh.take(&later), Some(answer));
}

#[test]
fn impossible_options_and_two_of_a_name_are_refused() {
    let refused = |options| match Recogniser::new(skills(), options) {
        Err(RecogniseError::Option { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    let good = RecogniseOptions::default();
    let bad = [
        (
            "place_sd_m",
            RecogniseOptions {
                place_sd_m: f64::NAN,
                ..good
            },
        ),
        (
            "reject_above",
            RecogniseOptions {
                reject_above: 0.0,
                ..good
            },
        ),
        (
            "temper",
            RecogniseOptions {
                temper: 1.5,
                ..good
            },
        ),
        ("leak", RecogniseOptions { leak: 1.0, ..good }),
    ];
    for (field, options) in bad {
        assert_eq!(refused(options), field);
    }
    let twice = [&skills()[0], &skills()[0]];
    assert!(matches!(
        Recogniser::new(twice, good),
        Err(RecogniseError::SameName { .. })
    ));
}

fn sets(gestures: &[&str], each: u64) -> Vec<Demonstrations> {
    let set = |gesture: &&str| Demonstrations {
        name: (*gesture).to_owned(),
        demonstrations: (0..each).map(|seed| demonstration(gesture, seed)).collect(),
        notices: Vec::new(),
    };
    gestures.iter().map(set).collect()
}

fn trial_options(split: Split) -> TrialOptions {
    TrialOptions {
        recognise: RecogniseOptions::default(),
        learn: quick(),
        split,
        persons: PersonPattern::default(),
        at_s: 0.7,
        also_at_s: vec![0.3],
    }
}

#[test]
fn a_trial_counts_what_it_saw_and_repeats_itself() {
    let sets = sets(&["circle", "push", "wipe"], 4);
    let strangers: Vec<_> = (0..3).map(|seed| demonstration("chop", seed)).collect();
    let options = trial_options(Split::Demonstrations { folds: 2 });
    let report = trial::run(&sets, &strangers, &options, |_, _| ()).unwrap();
    assert_eq!(
        (report.rounds, report.judged, report.not_judged),
        (2, 12, 0)
    );
    for (i, skill) in report.skills.iter().enumerate() {
        let all: usize = skill.taken_for.iter().sum::<usize>() + skill.refused;
        assert_eq!(all, 4, "{skill:?}");
        // Learned from two performances only.
        assert!(skill.taken_for[i] >= 3, "{skill:?}");
        assert!(skill.phase_error.unwrap() < 0.1, "{skill:?}");
    }
    assert!(report.refused_left_out[0].1.unwrap() >= 0.75, "{report:?}");
    assert!(report.refused_strangers[0].1.unwrap() >= 0.75, "{report:?}");
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    let again = one_thread.install(|| trial::run(&sets, &strangers, &options, |_, _| ()));
    assert_eq!(again, Ok(report));
}

#[test]
fn a_trial_that_cannot_be_is_refused_before_anything_is_learned() {
    let two = sets(&["circle", "push"], 2);
    let folds = Split::Demonstrations { folds: 2 };
    let run = |sets: &[Demonstrations], options| trial::run(sets, &[], &options, |_, _| ());
    let twice = [two[0].clone(), two[0].clone()];
    assert!(matches!(
        run(&twice, trial_options(folds)),
        Err(TrialError::SameName { .. })
    ));
    let mut options = trial_options(folds);
    options.at_s = f64::NAN;
    assert!(matches!(run(&two, options), Err(TrialError::Moment { .. })));
    let mut options = trial_options(folds);
    options.recognise.leak = 2.0;
    assert!(matches!(
        run(&two, options),
        Err(TrialError::Recognise(RecogniseError::Option { .. }))
    ));
    // All are by one person.
    assert!(matches!(
        run(&two, trial_options(Split::Persons)),
        Err(TrialError::Persons { .. })
    ));
}

#[test]
fn a_motion_over_before_it_began_is_still_recognised_without_a_fault() {
    let mut parts = skills()[0].parts().clone();
    parts.duration_s = 1e-300;
    let short = Skill::new(parts).unwrap();
    let mut r = Recogniser::new([&short], RecogniseOptions::default()).unwrap();
    let answers = watch(&mut r, &demonstration("circle", 10));
    assert!(answers.iter().all(|a| (0.0..=1.0).contains(&a.phase)));
}

proptest! {
    #[test]
    fn no_finite_hand_gives_nonsense(
        path in proptest::collection::vec((1_i64..2_000_000_000, -1e9..1e9, -3.0..3.0, 0.0..4.0), 1..30),
        scale in prop_oneof![Just(1.0), Just(1e-6), Just(1e150)],
    ) {
        let mut r = recogniser(RecogniseOptions::default());
        let mut s = HandState::first(Stamp(0), Vector3::zeros());
        for (dt, x, y, z) in path {
            s.advance(Stamp(s.t.0 + dt), Vector3::new(x, y, z) * scale);
            let Some(a) = r.take(&s) else { continue };
            for v in [a.probability, a.none, a.phase] {
                prop_assert!((0.0..=1.0).contains(&v), "{a:?}");
            }
            prop_assert!(a.phase_sd.is_finite() && a.novelty.is_finite(), "{a:?}");
            let all: f64 = r.probabilities().sum::<f64>() + a.none;
            prop_assert!((all - 1.0).abs() < 1e-9, "{a:?}");
        }
    }
}
