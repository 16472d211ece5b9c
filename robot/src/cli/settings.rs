//! What can be set of a robot, by flag, environment and file.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use nalgebra::Vector3;
use serde::Deserialize;
use telemime_endpoint::Fingerprint;
use telemime_endpoint::config::{Kind, Setting, Settings, Sheet, Unusable};
use telemime_endpoint::{admin, cli, logs, recording};
use telemime_sim::arm::{DeadTime, LoadOptions};

use super::{Args, surroundings};
use crate::control::{BarrierConfig, ControlConfig, ControlError, FilterConfig, LimitedFilter};
use crate::driver::{DriverConfig, FASTEST_HZ, PATIENCE_S, PatienceError};
use crate::rig::{Rig, RigError, RigOptions};
use crate::servo::Priority;

/// Where operators are listened for unless said otherwise.
pub(super) const LISTEN: &str = "0.0.0.0:4433";

/// The TOML file; every key may be left out.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    listen: Option<SocketAddr>,
    identity: Option<PathBuf>,
    #[serde(default)]
    peers: Vec<String>,
    peer_file: Option<PathBuf>,
    name: Option<String>,
    clock_dispersion: Option<String>,
    urdf: Option<PathBuf>,
    tip: Option<String>,
    #[serde(default)]
    fixed: BTreeMap<String, f64>,
    start: Option<Vec<f64>>,
    payload: Option<String>,
    keep_above_m: Option<f64>,
    /// Normal and place of each: what has n·x ≥ d is allowed.
    #[serde(default)]
    planes: Vec<[f64; 4]>,
    self_collision: Option<bool>,
    stop_distance_m: Option<f64>,
    slow_distance_m: Option<f64>,
    contact_plane: Option<[f64; 4]>,
    dead_time_s: Option<f64>,
    bandwidth_rad_s: Option<f64>,
    stiffness_nm_rad: Option<f64>,
    protocol_max: Option<u16>,
    record: Option<PathBuf>,
    driver: Option<String>,
    driver_patience_s: Option<f64>,
    realtime: Option<u8>,
    black_box: Option<PathBuf>,
    metrics: Option<SocketAddr>,
    foxglove: Option<SocketAddr>,
    log_format: Option<logs::Format>,
}

impl Settings for Args {
    fn sheet() -> Sheet {
        let new = Setting::new;
        let (control, barrier) = (ControlConfig::default(), BarrierConfig::default());
        Sheet {
            daemon: "robot",
            alternatives: &[],
            settings: vec![
                new("listen", "listen", Kind::Text, "\"0.0.0.0:4433\"").or(LISTEN),
                new("identity", "identity", Kind::Text, "\"robot.key\""),
                new(
                    "peers",
                    "peer",
                    Kind::Texts,
                    "[\"e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855\"]",
                ),
                new("peer_file", "peer-file", Kind::Text, "\"peers\""),
                new("name", "name", Kind::Text, "\"lab-arm\""),
                new(
                    "clock_dispersion",
                    "clock-dispersion",
                    Kind::Text,
                    "\"50us\"",
                ),
                new("urdf", "urdf", Kind::Text, "\"ur5e.urdf\""),
                new("tip", "tip", Kind::Text, "\"tool0\""),
                new(
                    "fixed",
                    "fixed",
                    Kind::NumberByName,
                    "{ finger_joint = 0.02 }",
                ),
                new(
                    "start",
                    "start",
                    Kind::Numbers,
                    "[0.0, -1.57, 1.57, -1.57, -1.57, 0.0]",
                ),
                new("payload", "payload", Kind::Text, "\"0.5@0,0,0.08\""),
                new("keep_above_m", "keep-above", Kind::Number, "0.02"),
                Setting::without_flag(
                    "planes",
                    Kind::Fours,
                    "[[-1.0, 0.0, 0.0, -0.9]]",
                    "Up to six planes: normal and place of what is allowed to the tip and the links that start there, \
                     n·x ≥ d, m.",
                ),
                Setting::without_flag(
                    "self_collision",
                    Kind::Switch,
                    "true",
                    "Keep the arm's links from each other.",
                )
                .or(barrier.self_collision),
                Setting::without_flag(
                    "stop_distance_m",
                    Kind::Number,
                    "0.02",
                    "Links are kept this far apart, m …",
                )
                .or(barrier.stop_m),
                Setting::without_flag(
                    "slow_distance_m",
                    Kind::Number,
                    "0.1",
                    "… and approached slower from this much farther on, m; planes likewise, from this distance on.",
                )
                .or(barrier.slow_m),
                new(
                    "contact_plane",
                    "contact-plane",
                    Kind::Four,
                    "[0.0, 0.0, 1.0, 0.0]",
                ),
                new("dead_time_s", "dead-time", Kind::Number, "0.02").or(control.dead_time_s),
                new("bandwidth_rad_s", "bandwidth", Kind::Number, "40.0").or(control.omega),
                new("stiffness_nm_rad", "stiffness", Kind::Number, "200.0"),
                new("protocol_max", "protocol-max", Kind::Integer, "1").or(1),
                new("record", "record", Kind::Text, "\"ticks.csv\""),
                new("driver", "driver", Kind::Text, "\"python3 arm.py\""),
                new("driver_patience_s", "driver-patience", Kind::Number, "0.1").or(PATIENCE_S),
                new("realtime", "realtime", Kind::Integer, "50"),
                new("black_box", "black-box", Kind::Text, "\"blackbox\""),
                new("metrics", "metrics", Kind::Text, "\"127.0.0.1:9433\""),
                new("foxglove", "foxglove", Kind::Text, "\"127.0.0.1:8765\""),
                new(
                    "log_format",
                    "log-format",
                    Kind::Choice(&["text", "json"]),
                    "\"text\"",
                ),
            ],
        }
    }

    fn over(mut self, below: toml::Table) -> anyhow::Result<Self> {
        let file: File = below
            .try_into()
            .map_err(|e: toml::de::Error| anyhow::anyhow!("{}", e.message()))?;
        self.listen = self.listen.or(file.listen);
        self.identity = self.identity.or(file.identity);
        if self.peer.is_empty() {
            self.peer = file.peers;
        }
        self.peer_file = self.peer_file.or(file.peer_file);
        self.name = self.name.or(file.name);
        let dispersion = file.clock_dispersion.as_deref().map(cli::dispersion);
        let dispersion = dispersion.transpose().map_err(anyhow::Error::msg)?;
        self.clock_dispersion = self.clock_dispersion.or(dispersion);
        self.urdf = self.urdf.or(file.urdf);
        self.tip = self.tip.or(file.tip);
        let named: Vec<_> = self.fixed.iter().map(|(joint, _)| joint.clone()).collect();
        let others = file.fixed.into_iter().filter(|(j, _)| !named.contains(j));
        self.fixed.extend(others);
        self.start = self.start.or(file.start);
        let payload = file.payload.as_deref().map(str::parse).transpose()?;
        self.payload = self.payload.or(payload);
        self.keep_above = self.keep_above.or(file.keep_above_m);
        self.planes = file.planes;
        self.self_collision = file.self_collision;
        self.stop_distance_m = file.stop_distance_m;
        self.slow_distance_m = file.slow_distance_m;
        self.contact_plane = self.contact_plane.or(file.contact_plane);
        self.dead_time = self.dead_time.or(file.dead_time_s);
        self.bandwidth = self.bandwidth.or(file.bandwidth_rad_s);
        self.stiffness = self.stiffness.or(file.stiffness_nm_rad);
        self.protocol_max = self.protocol_max.or(file.protocol_max);
        self.record = self.record.or(file.record);
        self.driver = self.driver.or(file.driver);
        self.driver_patience = self.driver_patience.or(file.driver_patience_s);
        self.realtime = self.realtime.or(file.realtime);
        self.black_box = self.black_box.or(file.black_box);
        self.metrics = self.metrics.or(file.metrics);
        self.foxglove = self.foxglove.or(file.foxglove);
        self.log_format = self.log_format.or(file.log_format);
        Ok(self)
    }

    fn judge(&self) -> anyhow::Result<()> {
        surroundings::barrier(self)?;
        surroundings::contact(self)?;
        self.fingerprints()?;
        admin::own_name(self.name.as_deref())?;
        // How often a driver speaks is not known before it does.
        self.driving(FASTEST_HZ)?;
        self.realtime.map(Priority::new).transpose()?;
        cli::versions(self.protocol_max)?;
        let control = self.control()?;
        DeadTime::new(control.dead_time_s, control.dt_s, ()).context("dead_time_s")?;
        let filter = FilterConfig {
            omega: control.omega,
            v_max: control.limits.v_max,
            a_max: control.limits.a_max,
            j_max: control.limits.j_max,
            dt_s: control.dt_s,
        };
        LimitedFilter::new(filter, Vector3::zeros()).context("bandwidth_rad_s")?;
        let lag_s = 3.0 / control.omega + control.dead_time_s;
        ensure!(
            lag_s <= MAX_LAG_S,
            "bandwidth_rad_s: {} rad/s and {} s of dead time put the arm {lag_s:.2} s behind its hand, and no operator drives one that is more than {MAX_LAG_S} s behind; {:.2} rad/s is the least, give more",
            control.omega,
            control.dead_time_s,
            3.0 / (MAX_LAG_S - control.dead_time_s)
        );
        ensure!(
            self.driver.is_none() || self.start.is_none(),
            "start and driver: an arm behind a driver starts where it is; leave one out"
        );
        Ok(())
    }

    fn rehearse(&self) -> anyhow::Result<()> {
        self.foxglove
            .map_or(Ok(()), |_| recording::live::is_built())?;
        let options = self.rig_options()?;
        let (urdf, text) = Rig::text(options.urdf.as_deref())?;
        if self.driver.is_some() {
            // Where the arm stands, the driver will say.
            let arm = Rig::arm(&urdf, &text, &options)?;
            options.control.fits(&arm)?;
        } else {
            Rig::read(urdf, &text, &options)?;
        }
        Ok(())
    }
}

/// Operators refuse a robot that says more (docs/protocol.md, `Info`), s.
const MAX_LAG_S: f64 = 2.0;

/// What was set and cannot be with this arm is no failure: the exit code tells.
pub(super) fn unusable(error: RigError) -> anyhow::Error {
    match &error {
        RigError::Control {
            source: ControlError::NoEffort { .. },
            ..
        } => Unusable::Judged(error.to_string()).into(),
        _ => error.into(),
    }
}

impl Args {
    /// The operators to let in besides those in the peer file.
    pub(super) fn fingerprints(&self) -> anyhow::Result<Vec<Fingerprint>> {
        let given = self.peer.iter().map(|text| text.parse());
        Ok(given.collect::<Result<_, _>>()?)
    }

    /// How a driver is waited for that tells its state `rate_hz` times a second.
    pub(super) fn driving(&self, rate_hz: f64) -> Result<DriverConfig, PatienceError> {
        DriverConfig::new(rate_hz, self.driver_patience.unwrap_or(PATIENCE_S))
    }

    /// The arm and how it is driven, as far as no driver says more.
    pub(super) fn rig_options(&self) -> anyhow::Result<RigOptions> {
        Ok(RigOptions {
            urdf: self.urdf.clone(),
            load: LoadOptions {
                tip: self.tip.clone(),
                fixed: self.fixed.iter().cloned().collect(),
                payload: self.payload,
            },
            contact: surroundings::contact(self)?,
            start: self.start.clone(),
            driver: self.driver.is_some(),
            control: self.control()?,
            ..RigOptions::default()
        })
    }

    /// How the arm is controlled.
    pub(super) fn control(&self) -> anyhow::Result<ControlConfig> {
        let default = ControlConfig::default();
        Ok(ControlConfig {
            dead_time_s: self.dead_time.unwrap_or(default.dead_time_s),
            omega: self.bandwidth.unwrap_or(default.omega),
            stiffness: self.stiffness,
            barrier: surroundings::barrier(self)?,
            ..default
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_printed_configuration_is_understood_and_complete() {
        // The document has it as it is printed (a test of the whole compares them).
        let lines = telemime_endpoint::config::example::<Args>();
        let lines = lines.lines().filter_map(|line| line.strip_prefix('#'));
        let settings: Vec<_> = lines.filter(|line| !line.starts_with(' ')).collect();
        let file: File = toml::from_str(&settings.join("\n")).unwrap();
        assert!(!format!("{file:?}").contains("None"), "a key is missing");
        assert_eq!((file.peers.len(), file.fixed["finger_joint"]), (1, 0.02));
    }

    #[test]
    fn a_filter_too_slow_for_any_operator_is_refused() {
        let slow = |bandwidth, dead_time| {
            let args = Args {
                bandwidth: Some(bandwidth),
                dead_time: Some(dead_time),
                ..Args::default()
            };
            args.judge().map_err(|e| e.to_string())
        };
        assert_eq!(slow(1.5, 0.0), Ok(()));
        let refused = slow(1.5, 0.05).unwrap_err();
        assert!(refused.contains("1.54 rad/s is the least"), "{refused}");
        assert!(slow(1.2, 0.0).is_err());
    }

    #[test]
    fn a_default_that_is_written_down_is_what_nothing_gives() {
        let told = |key: &str| Args::sheet().get(key).unwrap().default.clone().unwrap();
        let with = |key: &str| {
            let table = format!("{key} = {}", told(key)).parse().unwrap();
            Args::default().over(table).unwrap()
        };
        let nothing = Args::default();
        for key in [
            "dead_time_s",
            "bandwidth_rad_s",
            "self_collision",
            "stop_distance_m",
            "slow_distance_m",
        ] {
            let (said, not) = (with(key).control().unwrap(), nothing.control().unwrap());
            assert_eq!(format!("{said:?}"), format!("{not:?}"), "{key}");
        }
        let driving = with("driver_patience_s").driving(250.0).unwrap();
        assert_eq!(driving, nothing.driving(250.0).unwrap());
        let versions = |args: &Args| cli::versions(args.protocol_max).unwrap();
        assert_eq!(versions(&with("protocol_max")), versions(&nothing));
        assert_eq!(with("listen").listen, LISTEN.parse().ok());
    }
}
