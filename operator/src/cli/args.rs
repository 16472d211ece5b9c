//! Flags over a TOML file over defaults, checked.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use serde::Deserialize;
use telemime_endpoint::cli;

use super::input::{InputArgs, InputFile};
use crate::console::Shape;
use crate::placed::Placed;
use crate::session::{FutureBound, SessionConfig};

/// Teach, drive and play a robot.
///
/// Follows a tracked hand (--input), replays a recording as if the hand were there (--replay), or plays a learned
/// skill (--play). The robot must be
/// known: pair with it once (`telemime pair HOST:PORT`), or give the fingerprint it prints with --peer. On the
/// terminal, type stop (emergency stop), reset, or quit; engage and release are the clutch of --input; keep takes the performance driven last as a demonstration,
/// refine learns from those kept, and save FILE writes the skill as it is now.
#[derive(clap::Args, Debug, Clone, Default)]
pub struct Args {
    /// Read settings from this TOML file; flags override it.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// The robot: where it is, or the name it was paired by.
    #[arg(long, value_name = "HOST:PORT|NAME")]
    pub connect: Option<String>,
    /// This operator's private key, made if missing [default: ~/.config/telemime/operator.key].
    #[arg(long, value_name = "FILE")]
    pub identity: Option<PathBuf>,
    /// The robot's fingerprint, if it was not paired.
    #[arg(long, value_name = "FINGERPRINT")]
    pub peer: Option<String>,
    /// The robots that were paired [default: ~/.config/telemime/peers].
    #[arg(long, value_name = "FILE")]
    pub peer_file: Option<PathBuf>,
    /// The system clock is kept right (by PTP, chrony or the like) to within this, 50us for example; if the robot's is
    /// too, a path slower one way than the other is seen [default: round trips alone].
    #[arg(long, value_name = "TIME", value_parser = cli::dispersion)]
    pub clock_dispersion: Option<Duration>,
    /// Learn a skill from this folder of demonstrations (CSV: t,x,y,z) at the start; may be repeated.
    #[arg(long, value_name = "DIR")]
    pub learn: Vec<PathBuf>,
    /// Of those folders, only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN")]
    pub matching: Option<String>,
    /// Load a skill that `telemime learn` saved; may be repeated.
    #[arg(long, value_name = "FILE")]
    pub skill: Vec<PathBuf>,
    /// Save what --learn learned, and what --refine made of it, into this folder, one NAME.skill each.
    #[arg(long, value_name = "DIR")]
    pub save: Option<PathBuf>,
    /// Replay this recording (CSV: t,x,y,z) in real time, mirrored by the robot; may be repeated, one after another.
    #[arg(long, value_name = "FILE", conflicts_with = "play")]
    pub replay: Vec<PathBuf>,
    /// Replay: refine the skill with every performance, before the next one; --save keeps it.
    #[arg(long, conflicts_with = "play")]
    pub refine: bool,
    /// Play this skill: its inferred motion, compressed to checkpoints.
    #[arg(long, value_name = "SKILL")]
    pub play: Option<String>,
    /// Play: place a frame of the skill anew, m in the recordings' axes; may be repeated. The others stay where they
    /// usually were; the arm begins wherever it is, so that what counts is where the goal lies from the start.
    #[arg(
        long,
        value_name = "NAME=x,y,z[,qw,qx,qy,qz]",
        conflicts_with = "replay"
    )]
    pub frame: Vec<Placed>,
    /// Play: a hand corrects the motion; a recording (CSV: t,x,y,z) whose times count from when the robot begins. Where
    /// it has samples the hand holds on, and moving it bends the motion; where it has none for more than 0.25 s the hand
    /// has let go, and the skill goes on.
    #[arg(long, value_name = "FILE", conflicts_with = "replay")]
    pub correct: Option<PathBuf>,
    /// Serve a page to watch and drive from a browser, here [default: 127.0.0.1:8723]; beyond this host it takes the
    /// token in the address that is printed. Strokes drawn there are demonstrations.
    #[arg(
        long,
        value_name = "ADDR",
        num_args = 0..=1,
        default_missing_value = CONSOLE,
        conflicts_with_all = ["replay", "play"]
    )]
    pub console: Option<SocketAddr>,
    /// The page may set the link, which is like this now: delay and jitter in ms, loss in percent.
    #[arg(long, hide = true, requires = "console", value_name = "MS,MS,PERCENT", value_parser = parse_shape)]
    pub console_link: Option<Shape>,
    /// How exactly the hand means its corrections, m: against the skill's own deviation this decides how much they
    /// bend it [default: 0.02].
    #[arg(long, value_name = "M")]
    pub hand_sigma: Option<f64>,
    /// Play: largest error of the rebuilt motion, m [default: 1 % of the skill's reach].
    #[arg(long, value_name = "M")]
    pub bound: Option<f64>,
    /// Play: the rebuilt orientation passes this near the inferred one, rad [default: 0.02].
    #[arg(long, value_name = "RAD")]
    pub turn_bound: Option<f64>,
    /// Tip metres per hand metre [default: from the demonstrations and the arm's limits].
    #[arg(long)]
    pub scale: Option<f64>,
    /// A hand that is tracked while it drives.
    #[command(flatten)]
    pub input: InputArgs,
    /// The hand's axes [default: kinect].
    #[arg(long, value_enum)]
    pub axes: Option<Axes>,
    /// How old a sample is when the input hands it over, 0 to 300ms: `telemime tap` measures it [default: 0ms].
    #[arg(long, value_name = "TIME", value_parser = parse_latency)]
    pub input_latency: Option<f64>,
    /// For a tracker that takes something else for the hand now and then: replace one or two samples running that the
    /// predictor all but rules out. A hand that jumps farther than it ever did is believed two samples later.
    #[arg(long)]
    pub glitch_gate: bool,
    /// Prediction gain, 0 (none) to 1.
    #[arg(long)]
    pub gain: Option<f64>,
    /// ε_future: when the robot's prediction would be off by more, the operator speaks; a length (40mm, 0.04m) or a
    /// multiple of the predicted deviation (0.6sigma) [default: 1sigma].
    #[arg(long, value_name = "BOUND", value_parser = parse_future_bound)]
    pub future_bound: Option<FutureBound>,
    /// ε_path, m: the robot's record of the path is that exact [default: 2 % of the skill's reach].
    #[arg(long, value_name = "M")]
    pub path_bound: Option<f64>,
    /// The operator speaks at least this often, s [default: 0.2].
    #[arg(long, value_name = "S")]
    pub max_silence: Option<f64>,
    /// Two motions are at least this far apart, s, however fast the samples come [default: 0.01].
    #[arg(long, value_name = "S")]
    pub min_interval: Option<f64>,
    /// Each message authorises motion for this long, s [default: 0.65].
    #[arg(long, value_name = "S")]
    pub lease: Option<f64>,
    /// Replay: rest at the first position for this long, s [default: 1].
    #[arg(long, value_name = "S")]
    pub rest: Option<f64>,
    /// Give up if the robot is not reached within this time, s [default: 10].
    #[arg(long, value_name = "S")]
    pub patience: Option<f64>,
    /// Offer protocol versions up to this one; 2 is an experiment [default: 1].
    #[arg(long, value_name = "N")]
    pub protocol_max: Option<u16>,
    /// Record the hand, the arm as it is told, and all that is known of the link into this new MCAP file: Foxglove,
    /// Lichtblick and rerun open it, `telemime import` makes demonstrations of it.
    #[arg(long, value_name = "FILE.mcap")]
    pub record: Option<PathBuf>,
    /// Seed of learning.
    #[arg(long)]
    pub seed: Option<u64>,
    /// Print events as JSON lines on stdout.
    #[arg(long)]
    pub json: bool,
    /// Stop when stdin ends: for a parent process that must not leave orphans.
    #[arg(long, hide = true)]
    pub follow_stdin: bool,
}

/// Where the page is served unless said otherwise.
const CONSOLE: &str = "127.0.0.1:8723";

/// ε_path of what is driven in the page, m.
const CONSOLE_PATH_BOUND_M: f64 = 0.005;

fn parse_shape(text: &str) -> Result<Shape, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|n| n.parse().ok()).collect();
    let [delay_ms, jitter_ms, loss_percent] = numbers[..] else {
        return Err(format!("`{text}`: write three numbers"));
    };
    Ok(Shape {
        delay_ms,
        jitter_ms,
        loss_percent,
    })
}

/// How the tracker's axes lie to the robot's (x forward, y left, z up).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axes {
    /// The operator faces the sensor: x to the operator's right, y up, z away from the sensor.
    #[default]
    Kinect,
    /// The same axes as the robot's.
    Base,
}

impl Axes {
    /// The rotation from hand axes to base axes.
    pub fn rotation(self) -> UnitQuaternion<f64> {
        match self {
            Self::Base => UnitQuaternion::identity(),
            // Towards the sensor is forward, the operator's left is left, up is up.
            Self::Kinect => {
                let rows = Matrix3::new(0.0, 0.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 0.0);
                UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows))
            }
        }
    }
}

/// Longest silence that still lets the arm follow at full speed: the robot coasts after 0.26 s.
const MAX_SILENCE_S: f64 = 0.25;

/// Longest lease the robot grants, s.
const MAX_LEASE_S: f64 = 1.0;

fn parse_future_bound(text: &str) -> Result<FutureBound, String> {
    let wrong = || {
        format!("`{text}`: write a length (40mm, 0.04m) or a multiple of the deviation (0.6sigma)")
    };
    let number = |digits: &str| {
        digits
            .trim()
            .parse::<f64>()
            .ok()
            .filter(|v| v.is_finite() && *v >= 0.0)
            .ok_or_else(wrong)
    };
    if let Some(digits) = text.strip_suffix("sigma") {
        Ok(FutureBound::Relative(number(digits)?))
    } else if let Some(digits) = text.strip_suffix("mm") {
        Ok(FutureBound::Absolute(number(digits)? * 1e-3))
    } else if let Some(digits) = text.strip_suffix('m') {
        Ok(FutureBound::Absolute(number(digits)?))
    } else {
        Err(wrong())
    }
}

/// Longest latency of an input, ms: with the network's it must stay below what a robot accepts as fresh.
const MAX_LATENCY_MS: f64 = 300.0;

fn parse_latency(text: &str) -> Result<f64, String> {
    let (digits, factor) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
        (Some(digits), _) => (digits, 1.0),
        (None, Some(digits)) => (digits, 1e3),
        (None, None) => (text, 1.0),
    };
    let ms = digits.trim().parse::<f64>().ok().map(|v| v * factor);
    ms.filter(|ms| (0.0..=MAX_LATENCY_MS).contains(ms))
        .map(|ms| ms * 1e-3)
        .ok_or_else(|| format!("`{text}`: write a time from 0 to {MAX_LATENCY_MS} ms (62ms)"))
}

/// One file, or several.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum Files {
    One(PathBuf),
    Several(Vec<PathBuf>),
}

impl From<Files> for Vec<PathBuf> {
    fn from(files: Files) -> Self {
        match files {
            Files::One(file) => vec![file],
            Files::Several(files) => files,
        }
    }
}

/// The TOML file; every key may be left out.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    connect: Option<String>,
    identity: Option<PathBuf>,
    peer: Option<String>,
    peer_file: Option<PathBuf>,
    clock_dispersion: Option<String>,
    #[serde(default)]
    learn: Vec<PathBuf>,
    #[serde(rename = "match")]
    matching: Option<String>,
    #[serde(default)]
    skills: Vec<PathBuf>,
    replay: Option<Files>,
    refine: Option<bool>,
    play: Option<String>,
    console: Option<SocketAddr>,
    #[serde(default)]
    frames: BTreeMap<String, Vec<f64>>,
    correct: Option<PathBuf>,
    hand_sigma_m: Option<f64>,
    bound_m: Option<f64>,
    turn_bound_rad: Option<f64>,
    scale: Option<f64>,
    axes: Option<Axes>,
    #[serde(default)]
    input: InputFile,
    gain: Option<f64>,
    future_bound: Option<String>,
    path_bound_m: Option<f64>,
    max_silence_s: Option<f64>,
    min_interval_s: Option<f64>,
    lease_s: Option<f64>,
    rest_s: Option<f64>,
    patience_s: Option<f64>,
    protocol_max: Option<u16>,
    record: Option<PathBuf>,
    seed: Option<u64>,
}

fn read_config(path: &Path) -> anyhow::Result<File> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    toml::from_str(&text).map_err(|e| anyhow::anyhow!("{}: {e}", path.display()))
}

impl Args {
    /// These flags over the file they name.
    pub(super) fn merged(mut self) -> anyhow::Result<Self> {
        let Some(path) = self.config.clone() else {
            return Ok(self);
        };
        let file = read_config(&path)?;
        let bound = file
            .future_bound
            .as_deref()
            .map(parse_future_bound)
            .transpose();
        let bound = bound.map_err(|e| anyhow::anyhow!("{}: future_bound = {e}", path.display()))?;
        self.connect = self.connect.or(file.connect);
        self.identity = self.identity.or(file.identity);
        self.peer = self.peer.or(file.peer);
        self.peer_file = self.peer_file.or(file.peer_file);
        let dispersion = file.clock_dispersion.as_deref().map(cli::dispersion);
        let dispersion = dispersion.transpose().map_err(anyhow::Error::msg)?;
        self.clock_dispersion = self.clock_dispersion.or(dispersion);
        if self.learn.is_empty() && self.skill.is_empty() {
            (self.learn, self.skill) = (file.learn, file.skills);
        }
        self.matching = self.matching.or(file.matching);
        let free = self.replay.is_empty() && self.play.is_none() && self.console.is_none();
        if free && self.input.input.is_none() {
            self.replay = file.replay.map_or_else(Vec::new, Vec::from);
            self.play = file.play;
            self.console = file.console;
            // As on the command line: there is nothing to refine by what is only played.
            self.refine |= file.refine.unwrap_or(false) && self.play.is_none();
        }
        if let Some(ms) = file
            .input
            .latency_ms
            .filter(|_| self.input_latency.is_none())
        {
            let latency = parse_latency(&format!("{ms}ms"));
            let latency = latency
                .map_err(|e| anyhow::anyhow!("{}: [input] latency_ms = {e}", path.display()))?;
            self.input_latency = Some(latency);
        }
        self.glitch_gate |= file.input.glitch_gate.unwrap_or(false);
        let other = self.play.is_some() || self.console.is_some() || !self.replay.is_empty();
        let input = self.input.over(file.input, !other);
        input.with_context(|| path.display().to_string())?;
        if self.frame.is_empty() && self.play.is_some() {
            self.frame = file
                .frames
                .iter()
                .map(|(name, numbers)| Placed::new(name, numbers))
                .collect::<Result<_, _>>()
                .with_context(|| format!("{}: [frames]", path.display()))?;
        }
        if self.play.is_some() {
            self.correct = self.correct.or(file.correct);
        }
        self.hand_sigma = self.hand_sigma.or(file.hand_sigma_m);
        self.bound = self.bound.or(file.bound_m);
        self.turn_bound = self.turn_bound.or(file.turn_bound_rad);
        self.scale = self.scale.or(file.scale);
        self.axes = self.axes.or(file.axes);
        self.gain = self.gain.or(file.gain);
        self.future_bound = self.future_bound.or(bound);
        self.path_bound = self.path_bound.or(file.path_bound_m);
        self.max_silence = self.max_silence.or(file.max_silence_s);
        self.min_interval = self.min_interval.or(file.min_interval_s);
        self.lease = self.lease.or(file.lease_s);
        self.rest = self.rest.or(file.rest_s);
        self.patience = self.patience.or(file.patience_s);
        self.protocol_max = self.protocol_max.or(file.protocol_max);
        self.record = self.record.or(file.record);
        self.seed = self.seed.or(file.seed);
        Ok(self)
    }

    /// Whether all there is to predict with is what will be taught in the page: its hand moves in base axes, metre for
    /// metre.
    fn is_taught_in_the_page(&self) -> bool {
        self.console.is_some() && self.learn.is_empty() && self.skill.is_empty()
    }

    pub(super) fn session(&self) -> anyhow::Result<SessionConfig> {
        let page = self.is_taught_in_the_page();
        let axes = if page { Axes::Base } else { Axes::Kinect };
        let defaults = SessionConfig::default();
        let config = SessionConfig {
            max_silence_s: self.max_silence.unwrap_or(defaults.max_silence_s),
            min_interval_s: self.min_interval.unwrap_or(defaults.min_interval_s),
            lease_s: self.lease.unwrap_or(defaults.lease_s),
            future_bound: self.future_bound.unwrap_or(defaults.future_bound),
            path_bound_m: self.path_bound.or(page.then_some(CONSOLE_PATH_BOUND_M)),
            input_latency_s: self.input_latency.unwrap_or(0.0),
            glitch_gate: self.glitch_gate,
            gain: self.gain.unwrap_or(defaults.gain),
            hand_sigma_m: self.hand_sigma.unwrap_or(defaults.hand_sigma_m),
            scale: self.scale.or(page.then_some(1.0)),
            rotation: self.axes.unwrap_or(axes).rotation(),
            versions: telemime_endpoint::cli::versions(self.protocol_max)?,
        };
        let within = |name: &str, value: f64, low: f64, high: f64| -> anyhow::Result<()> {
            if !(value > low && value <= high) {
                bail!("{name} is {value}: it must be above {low} and at most {high}");
            }
            Ok(())
        };
        within("--max-silence", config.max_silence_s, 0.005, MAX_SILENCE_S)
            .context("the robot coasts after 0.26 s without news")?;
        within("--lease", config.lease_s, config.max_silence_s, MAX_LEASE_S)
            .context("the robot grants 1 s at most, and a lease must outlast the silence")?;
        within(
            "--min-interval",
            config.min_interval_s,
            -f64::EPSILON,
            config.max_silence_s,
        )?;
        within("--hand-sigma", config.hand_sigma_m, 0.0, 1.0)?;
        within("--gain", config.gain, -f64::EPSILON, 1.0)?;
        if let Some(scale) = config.scale {
            within("--scale", scale, 0.0, 10.0)?;
        }
        if let Some(bound_m) = config.path_bound_m {
            within("--path-bound", bound_m, 0.0, 10.0)?;
        }
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_kinect_hand_moving_towards_the_sensor_moves_the_tip_forward() {
        let rotation = Axes::Kinect.rotation();
        let to = |x, y, z| rotation * Vector3::new(x, y, z);
        assert!((to(0.0, 0.0, -1.0) - Vector3::x()).norm() < 1e-12);
        assert!((to(-1.0, 0.0, 0.0) - Vector3::y()).norm() < 1e-12);
        assert!((to(0.0, 1.0, 0.0) - Vector3::z()).norm() < 1e-12);
    }

    #[test]
    fn bounds_are_lengths_or_multiples() {
        assert_eq!(parse_future_bound("40mm"), Ok(FutureBound::Absolute(0.04)));
        assert_eq!(parse_future_bound("0.04m"), Ok(FutureBound::Absolute(0.04)));
        assert_eq!(
            parse_future_bound("0.6sigma"),
            Ok(FutureBound::Relative(0.6))
        );
        for bad in ["", "40", "mm", "-1mm", "nanmm", "infsigma"] {
            assert!(parse_future_bound(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn flags_override_the_file_and_unknown_keys_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("operator.toml");
        std::fs::write(
            &path,
            "connect = \"robot:4433\"\nscale = 0.2\nfuture_bound = \"40mm\"\n",
        )
        .unwrap();
        let args = Args {
            config: Some(path.clone()),
            scale: Some(0.1),
            ..Args::default()
        };
        let merged = args.clone().merged().unwrap();
        assert_eq!(
            (merged.connect.as_deref(), merged.scale),
            (Some("robot:4433"), Some(0.1))
        );
        assert_eq!(
            merged.session().unwrap().future_bound,
            FutureBound::Absolute(0.04)
        );
        std::fs::write(&path, "conect = \"robot:4433\"\n").unwrap();
        let error = args.merged().unwrap_err().to_string();
        assert!(
            error.contains("conect") && error.contains("operator.toml"),
            "{error}"
        );
    }

    #[test]
    fn the_documented_configuration_is_understood_and_complete() {
        let text = include_str!("../../../docs/commands.md");
        let example = text
            .split("```toml operator\n")
            .nth(1)
            .and_then(|rest| rest.split("```").next())
            .unwrap()
            .replace("# play", "play")
            .replace("# console", "console")
            .replace("# correct", "correct")
            .replace("# hand_sigma_m", "hand_sigma_m")
            .replace("# bound_m", "bound_m")
            .replace("# turn_bound_rad", "turn_bound_rad");
        let file: File = toml::from_str(&example).unwrap();
        assert!(!file.frames.is_empty(), "[frames] is missing");
        assert!(!format!("{file:?}").contains("None"), "a key is missing");
        parse_future_bound(&file.future_bound.unwrap()).unwrap();
    }

    #[test]
    fn impossible_settings_are_refused_by_name() {
        let refused = |args: Args| format!("{:#}", args.session().unwrap_err());
        assert!(
            refused(Args {
                lease: Some(0.1),
                ..Args::default()
            })
            .contains("--lease")
        );
        // What the robot would cut down in silence.
        assert!(
            refused(Args {
                lease: Some(1.5),
                ..Args::default()
            })
            .contains("1 s at most")
        );
        assert!(
            refused(Args {
                max_silence: Some(0.3),
                ..Args::default()
            })
            .contains("0.26 s")
        );
        assert!(
            refused(Args {
                gain: Some(1.5),
                ..Args::default()
            })
            .contains("--gain")
        );
        assert!(
            refused(Args {
                scale: Some(f64::NAN),
                ..Args::default()
            })
            .contains("--scale")
        );
    }
}
