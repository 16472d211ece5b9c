//! The factors of a plan: what each is called, what it may be, and what it changes.

use std::path::{Path, PathBuf};

use telemime_operator::session::{FutureBound, MAX_LEASE_S, MAX_SILENCE_S, SessionConfig};
use telemime_sim::link::{LinkConfig, parse_duration_s};

use super::method::Method;

/// One factor.
pub(super) struct Factor {
    /// As in a plan, and as a column of the results.
    pub(super) name: &'static str,
    /// Its value where a plan says nothing.
    pub(super) default: &'static [&'static str],
    /// What it is.
    pub(super) meaning: &'static str,
    /// Whom it concerns: ours, those that send raw samples, play-back, the floor.
    concerns: [bool; 4],
}

/// What a factor is set to where it changes nothing.
pub(super) const UNUSED: &str = "-";

/// Both directions at once.
pub(super) const LINK: &str = "link";

const fn factor(
    name: &'static str,
    default: &'static [&'static str],
    meaning: &'static str,
    concerns: [bool; 4],
) -> Factor {
    Factor {
        name,
        default,
        meaning,
        concerns,
    }
}

const ALL: [bool; 4] = [true; 4];
const OURS: [bool; 4] = [true, false, false, false];
const SENT: [bool; 4] = [true, true, true, false];

/// Every factor, in the order of the columns.
pub(super) const FACTORS: [Factor; 16] = [
    factor(
        "motion",
        &["on-model", "off-model"],
        "what is driven: the motion that was demonstrated, or another one",
        ALL,
    ),
    factor(
        "method",
        &["ours", "hold", "floor"],
        "ours, hold, deadband [SHARE], velocity, kalman, playback, floor",
        ALL,
    ),
    factor(
        "up",
        &["delay 100ms 10ms loss 1%"],
        "the link from operator to robot, in netem's words; `link` sets both ways",
        SENT,
    ),
    factor(
        "down",
        &["delay 100ms 10ms loss 1%"],
        "the link from robot to operator",
        OURS,
    ),
    factor(
        "outage",
        &["none"],
        "both ways cut, from..to in the recording's time",
        SENT,
    ),
    factor(
        "input_latency",
        &["0ms"],
        "every sample is handed over this late, and the operator is told so",
        SENT,
    ),
    factor(
        "future",
        &["0.2 way"],
        "bound on the future: a share of the way the hand usually goes, a distance, or sigmas of what is predicted",
        OURS,
    ),
    factor("path", &["auto"], "bound on the path, a distance", OURS),
    factor(
        "silence",
        &["200ms"],
        "the operator speaks at least this often",
        OURS,
    ),
    factor(
        "lease",
        &["650ms"],
        "for how long a message authorises motion",
        OURS,
    ),
    factor(
        "bandwidth",
        &["40"],
        "of the filter before the arm, rad/s",
        ALL,
    ),
    factor("dead_time", &["0ms"], "the arm obeys this much late", ALL),
    factor("arm", &["mime7"], "mime7, or a URDF file", ALL),
    factor("scale", &["auto"], "tip metres per hand metre", ALL),
    factor(
        "prediction",
        &["1"],
        "gain of the prediction: 1 is on, 0 is off",
        OURS,
    ),
    factor(
        "link_seed",
        &["1"],
        "seed of the link's chances: numbers, or \"1..10\"",
        SENT,
    ),
];

/// The texts of one run's factors, in the order of [`FACTORS`].
pub(super) type Texts = [String; FACTORS.len()];

/// The index of a factor.
pub(super) fn index(name: &str) -> Option<usize> {
    FACTORS.iter().position(|f| f.name == name)
}

/// The text of the factor `name`, which exists.
pub(super) fn of<'a>(texts: &'a Texts, name: &str) -> &'a str {
    &texts[index(name).expect("named by this program")]
}

/// `texts` as `method` sees them: what does not concern it is [`UNUSED`].
pub(super) fn seen_by(texts: &Texts, method: Method) -> Texts {
    let whom = match method {
        Method::Ours => 0,
        Method::Hold | Method::Deadband(_) | Method::Velocity(_) | Method::Kalman => 1,
        Method::Playback => 2,
        Method::Floor => 3,
    };
    std::array::from_fn(|n| match FACTORS[n].name {
        "method" => method.to_string(),
        _ if FACTORS[n].concerns[whom] => texts[n].clone(),
        _ => UNUSED.to_owned(),
    })
}

/// What one run is set to.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Settings {
    pub(super) on_model: bool,
    pub(super) method: Method,
    pub(super) up: LinkConfig,
    pub(super) down: LinkConfig,
    /// From, to, s of the recording.
    pub(super) outage_s: Option<(f64, f64)>,
    pub(super) input_latency_s: f64,
    pub(super) future: FutureBound,
    pub(super) path_m: Option<f64>,
    pub(super) silence_s: f64,
    pub(super) lease_s: f64,
    pub(super) omega: f64,
    pub(super) dead_time_s: f64,
    /// A URDF file; `None` is the built-in arm.
    pub(super) arm: Option<PathBuf>,
    pub(super) scale: Option<f64>,
    pub(super) gain: f64,
    pub(super) link_seed: u64,
}

impl Settings {
    /// What `texts` say; files are looked for beside `folder`. [`UNUSED`] stands for the default.
    pub(super) fn read(texts: &Texts, folder: &Path) -> Result<Self, String> {
        let text = |name: &str| match of(texts, name) {
            UNUSED => FACTORS[index(name).expect("named by this program")].default[0],
            text => text,
        };
        let seconds = |name: &str| parse_duration_s(text(name)).map_err(|e| e.to_string());
        let silence_s = within(
            seconds("silence")?,
            0.005,
            MAX_SILENCE_S,
            "5ms to 250ms, as an operator takes",
        )?;
        let lease_s = seconds("lease")?;
        let travels = SessionConfig {
            lease_s,
            ..SessionConfig::default()
        };
        let travels_s = f64::from(travels.lease_ms()) * 1e-3;
        if !(travels_s > silence_s && lease_s <= MAX_LEASE_S) {
            return Err(
                "a lease, in whole steps of 10ms, is longer than the silence, and at most 1s: a robot grants no more".into(),
            );
        }
        Ok(Self {
            on_model: match text("motion") {
                "on-model" => true,
                "off-model" => false,
                _ => return Err("write on-model or off-model".into()),
            },
            method: text("method").parse()?,
            up: link(text("up"), folder)?,
            down: link(text("down"), folder)?,
            outage_s: outage(text("outage"))?,
            input_latency_s: within(seconds("input_latency")?, 0.0, 1.0, "0ms to 1s")?,
            future: future(text("future"))?,
            path_m: auto(text("path"), distance_m)?,
            silence_s,
            lease_s,
            omega: within(number(text("bandwidth"))?, 1.0, 200.0, "1 to 200")?,
            dead_time_s: within(seconds("dead_time")?, 0.0, 0.05, "0ms to 50ms")?,
            arm: arm(text("arm"), folder)?,
            scale: auto(text("scale"), |t| {
                within(number(t)?, 1e-3, 10.0, "auto, or 0.001 to 10")
            })?,
            gain: match text("prediction") {
                "true" | "on" => 1.0,
                "false" | "off" => 0.0,
                other => within(number(other)?, 0.0, 1.0, "on, off, or 0 to 1")?,
            },
            link_seed: text("link_seed")
                .parse()
                .map_err(|_| "write a whole number from 0 on, or a range like \"1..10\"")?,
        })
    }
}

fn number(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite());
    value.ok_or_else(|| "not a number".to_owned())
}

fn within(value: f64, least: f64, most: f64, what: &str) -> Result<f64, String> {
    let fits = (least..=most).contains(&value);
    fits.then_some(value)
        .ok_or_else(|| format!("out of range: {what}"))
}

fn distance_m(text: &str) -> Result<f64, String> {
    let (number_text, unit_m) = match (text.strip_suffix("mm"), text.strip_suffix('m')) {
        (Some(mm), _) => (mm, 1e-3),
        (None, Some(m)) => (m, 1.0),
        _ => return Err("write a distance, for example 20mm or 0.02m".into()),
    };
    within(number(number_text)? * unit_m, 1e-4, 1.0, "0.1mm to 1m")
}

fn auto<T>(text: &str, read: impl Fn(&str) -> Result<T, String>) -> Result<Option<T>, String> {
    (text != "auto").then(|| read(text)).transpose()
}

fn future(text: &str) -> Result<FutureBound, String> {
    let times = |n: &str, what| within(number(n)?, 0.01, 100.0, what);
    if let Some(n) = text.strip_suffix("way") {
        times(n, "0.01 to 100 way").map(FutureBound::Share)
    } else if let Some(n) = text.strip_suffix("sigma") {
        times(n, "0.01 to 100 sigma").map(FutureBound::Relative)
    } else {
        distance_m(text)
            .map(FutureBound::Absolute)
            .map_err(|_| "write `0.2 way`, `1 sigma` or a distance, for example 20mm".into())
    }
}

fn outage(text: &str) -> Result<Option<(f64, f64)>, String> {
    if text == "none" {
        return Ok(None);
    }
    let wrong = || "write none, or for example 3s..3.5s".to_owned();
    let (from, to) = text.split_once("..").ok_or_else(wrong)?;
    let (from_s, to_s) = (parse_duration_s(from), parse_duration_s(to));
    let (Ok(from_s), Ok(to_s)) = (from_s, to_s) else {
        return Err(wrong());
    };
    if to_s <= from_s {
        return Err("it ends before it begins".into());
    }
    Ok(Some((from_s, to_s)))
}

fn arm(text: &str, folder: &Path) -> Result<Option<PathBuf>, String> {
    if text == "mime7" {
        return Ok(None);
    }
    let path = folder.join(text);
    match std::fs::metadata(&path) {
        Ok(found) if found.is_file() => Ok(Some(path)),
        Ok(_) => Err(format!("{} is not a file", path.display())),
        Err(e) => Err(format!(
            "{}: {e}; paths begin at the plan's folder",
            path.display()
        )),
    }
}

/// A link from netem's words, traces looked for beside `folder`; `perfect` is a wire.
pub(super) fn link(text: &str, folder: &Path) -> Result<LinkConfig, String> {
    if text == "perfect" {
        return Ok(LinkConfig::default());
    }
    LinkConfig::parse_in(text, folder).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(set: &[(&str, &str)]) -> Texts {
        let mut texts: Texts = std::array::from_fn(|n| FACTORS[n].default[0].to_owned());
        for (name, value) in set {
            texts[index(name).unwrap()] = (*value).to_owned();
        }
        texts
    }

    #[test]
    fn defaults_are_what_the_daemons_are_set_to() {
        let settings = Settings::read(&texts(&[]), Path::new(".")).unwrap();
        let session = SessionConfig::default();
        assert_eq!(settings.future, session.future_bound);
        assert_eq!(settings.path_m, session.path_bound_m);
        assert_eq!(settings.silence_s, session.max_silence_s);
        assert_eq!(settings.lease_s, session.lease_s);
        assert_eq!(settings.gain, session.gain);
        let control = telemime_robot::control::ControlConfig::default();
        assert_eq!(settings.omega, control.omega);
        assert_eq!(settings.dead_time_s, control.dead_time_s);
    }

    #[test]
    fn values_are_read_or_refused_with_a_remedy() {
        let read = |name, value| Settings::read(&texts(&[(name, value)]), Path::new("."));
        assert_eq!(
            read("outage", "3s..3.5s").unwrap().outage_s,
            Some((3.0, 3.5))
        );
        assert_eq!(read("prediction", "off").unwrap().gain, 0.0);
        assert_eq!(
            read("future", "20mm").unwrap().future,
            FutureBound::Absolute(0.02)
        );
        assert_eq!(read("scale", "0.1").unwrap().scale, Some(0.1));
        for (name, value) in [
            ("motion", "sideways"),
            ("method", "magic"),
            ("outage", "3s..2s"),
            ("future", "20"),
            ("bandwidth", "nan"),
            ("arm", "missing.urdf"),
            ("dead_time", "1s"),
            ("link_seed", "-1"),
            ("up", "delay never"),
        ] {
            assert!(read(name, value).is_err(), "{name} = {value}");
        }
    }

    #[test]
    fn what_does_not_concern_a_method_makes_no_further_run() {
        let a = texts(&[("future", "20mm"), ("up", "delay 50ms"), ("link_seed", "3")]);
        let hold = seen_by(&a, Method::Hold);
        assert_eq!(
            (of(&hold, "future"), of(&hold, "up")),
            (UNUSED, "delay 50ms")
        );
        let floor = seen_by(&a, Method::Floor);
        assert_eq!(
            (of(&floor, "up"), of(&floor, "link_seed")),
            (UNUSED, UNUSED)
        );
        assert_eq!(of(&floor, "method"), "floor");
        assert!(Settings::read(&floor, Path::new(".")).is_ok());
    }
}
