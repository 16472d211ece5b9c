//! The flags, and what a session makes of them.

use std::f64::consts::PI;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use serde::Deserialize;
use telemime_endpoint::{cli, logs};

use super::input::InputArgs;
use crate::console::Shape;
use crate::placed::Placed;
use crate::session::{FutureBound, MAX_LEASE_S, MAX_SILENCE_S, SessionConfig};

/// Teach, drive and play a robot.
///
/// Follows a tracked hand (--input), replays a recording as if the hand were there (--replay), or plays a learned
/// skill (--play). The robot must be
/// known: pair with it once (`telemime pair HOST:PORT`), or give the fingerprint it prints with --peer. On the
/// terminal, type stop (emergency stop), reset, or quit; engage and release are the clutch of --input; keep takes the performance driven last as a demonstration,
/// refine learns from those kept, and save FILE writes the skill as it is now.
#[derive(clap::Args, Debug, Clone, Default)]
pub struct Args {
    /// Read settings from this TOML file; the environment (TELEMIME_OPERATOR_…) overrides it, and flags both.
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
    /// ε_future: when the robot's prediction would be off by more, the operator speaks; a share of the way the hand
    /// usually goes until a message takes effect (0.2way), a length (40mm, 0.04m) or a multiple of the predicted deviation
    /// (0.6sigma) [default: 0.2way].
    #[arg(long, value_name = "BOUND", value_parser = parse_future_bound)]
    pub future_bound: Option<FutureBound>,
    /// ε_path, m: the robot's record of the path is that exact [default: 2 % of the skill's reach].
    #[arg(long, value_name = "M")]
    pub path_bound: Option<f64>,
    /// The same of the hand's orientation, where it has one, rad, up to half a turn; 0: the path is of the place only
    /// [default: 0.05].
    #[arg(long, value_name = "RAD")]
    pub path_turn_bound: Option<f64>,
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
    /// Serve metrics for Prometheus at http://ADDR/metrics [127.0.0.1:9434 if no address is given].
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = METRICS)]
    pub metrics: Option<SocketAddr>,
    /// Show viewers (Foxglove, Lichtblick) at ws://ADDR what --record would write, as it happens [127.0.0.1:8766 if no
    /// address is given]; only in a program built with `--features live`.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = FOXGLOVE)]
    pub foxglove: Option<SocketAddr>,
    /// Log to stderr what happens, each line with time and level, instead of telling it on stdout; RUST_LOG chooses what.
    #[arg(long, value_name = "FORMAT", value_enum)]
    pub log_format: Option<logs::Format>,
    /// Print an example of the configuration file, with the defaults, and end.
    #[arg(long)]
    pub print_config: bool,
    /// Print the configuration file's JSON Schema, and end.
    #[arg(long)]
    pub print_schema: bool,
    /// Print events as JSON lines on stdout.
    #[arg(long)]
    pub json: bool,
    /// Stop when stdin ends: for a parent process that must not leave orphans.
    #[arg(long, hide = true)]
    pub follow_stdin: bool,
}

/// Where metrics are served unless said otherwise.
const METRICS: &str = "127.0.0.1:9434";

/// Where viewers connect unless said otherwise.
const FOXGLOVE: &str = "127.0.0.1:8766";

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

/// The bound that these words name: a share of the way (`0.2way`), a length (`40mm`, `0.04m`) or a multiple of the deviation (`0.6sigma`).
///
/// # Errors
/// What may be written.
pub fn parse_future_bound(text: &str) -> Result<FutureBound, String> {
    let wrong = || {
        format!(
            "`{text}`: write a share of the way (0.2way), a length (40mm, 0.04m) or a multiple of the deviation (0.6sigma)"
        )
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
    } else if let Some(digits) = text.strip_suffix("way") {
        Ok(FutureBound::Share(number(digits)?))
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

pub(super) fn parse_latency(text: &str) -> Result<f64, String> {
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

impl Args {
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
            path_turn_bound_rad: self.path_turn_bound.unwrap_or(defaults.path_turn_bound_rad),
            input_latency_s: self.input_latency.unwrap_or(0.0),
            glitch_gate: self.glitch_gate,
            gain: self.gain.unwrap_or(defaults.gain),
            hand_sigma_m: self.hand_sigma.unwrap_or(defaults.hand_sigma_m),
            scale: self.scale.or(page.then_some(1.0)),
            rotation: self.axes.unwrap_or(axes).rotation(),
            versions: cli::versions(self.protocol_max)?,
        };
        let within = |name: &str, value: f64, low: f64, high: f64| -> anyhow::Result<()> {
            if !(value > low && value <= high) {
                bail!("{name} is {value}: it must be above {low} and at most {high}");
            }
            Ok(())
        };
        within("--max-silence", config.max_silence_s, 0.005, MAX_SILENCE_S)
            .context("the robot coasts after 0.26 s without news")?;
        let lease_s = f64::from(config.lease_ms()) * 1e-3;
        within("--lease", lease_s, config.max_silence_s, MAX_LEASE_S)
            .context("the robot grants 1 s at most, and a lease, which travels in steps of 10 ms, must outlast the silence")?;
        within(
            "--min-interval",
            config.min_interval_s,
            -f64::EPSILON,
            config.max_silence_s,
        )?;
        within("--hand-sigma", config.hand_sigma_m, 0.0, 1.0)?;
        within("--gain", config.gain, -f64::EPSILON, 1.0)?;
        if let Some(rest_s) = self.rest {
            within("--rest", rest_s, -f64::EPSILON, 60.0)?;
        }
        if let Some(patience_s) = self.patience {
            within("--patience", patience_s, 0.0, 3600.0)?;
        }
        if let Some(scale) = config.scale {
            within("--scale", scale, 0.0, 10.0)?;
        }
        if let Some(bound_m) = config.path_bound_m {
            within("--path-bound", bound_m, 0.0, 10.0)?;
        }
        let turn_rad = config.path_turn_bound_rad;
        within("--path-turn-bound", turn_rad, -f64::EPSILON, PI)?;
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
        assert_eq!(parse_future_bound("0.2 way"), Ok(FutureBound::Share(0.2)));
        for bad in ["", "40", "mm", "-1mm", "nanmm", "infsigma", "way", "-1way"] {
            assert!(parse_future_bound(bad).is_err(), "{bad}");
        }
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
        // It would travel as no more than the silence.
        assert!(
            refused(Args {
                max_silence: Some(0.2),
                lease: Some(0.2099),
                ..Args::default()
            })
            .contains("steps of 10 ms")
        );
        for lease in [1e3, f64::NAN, f64::INFINITY] {
            let lease = Some(lease);
            assert!(
                refused(Args {
                    lease,
                    ..Args::default()
                })
                .contains("--lease")
            );
        }
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
