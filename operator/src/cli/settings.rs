//! What can be set of an operator, by flag, environment and file.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context;
use serde::Deserialize;
use telemime_endpoint::config::{Kind, Setting, Settings, Sheet};
use telemime_endpoint::{Fingerprint, cli, logs, recording};

use super::args::{Args, Axes, parse_future_bound, parse_latency};
use super::input::InputFile;
use crate::ingest::FPS;
use crate::input::stick::SPEED_M_S;
use crate::placed::Placed;
use crate::session::SessionConfig;

/// How long a replay rests at its first position, s, and how long the first connection may take, s, unless said otherwise.
pub(super) const REST_S: f64 = 1.0;
pub(super) const PATIENCE_S: f64 = 10.0;

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
    path_turn_bound_rad: Option<f64>,
    max_silence_s: Option<f64>,
    min_interval_s: Option<f64>,
    lease_s: Option<f64>,
    rest_s: Option<f64>,
    patience_s: Option<f64>,
    protocol_max: Option<u16>,
    record: Option<PathBuf>,
    seed: Option<u64>,
    metrics: Option<SocketAddr>,
    foxglove: Option<SocketAddr>,
    log_format: Option<logs::Format>,
}

impl Settings for Args {
    fn sheet() -> Sheet {
        let new = Setting::new;
        let session = SessionConfig::default();
        Sheet {
            daemon: "operator",
            alternatives: &[
                &["replay", "play", "console", "input.source"],
                &["learn", "skills"],
            ],
            settings: vec![
                new("connect", "connect", Kind::Text, "\"robot.example:4433\""),
                new("identity", "identity", Kind::Text, "\"operator.key\""),
                new(
                    "peer",
                    "peer",
                    Kind::Text,
                    "\"e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855\"",
                ),
                new("peer_file", "peer-file", Kind::Text, "\"peers\""),
                new(
                    "clock_dispersion",
                    "clock-dispersion",
                    Kind::Text,
                    "\"50us\"",
                ),
                new("learn", "learn", Kind::Texts, "[\"recordings/wave\"]"),
                new("match", "match", Kind::Text, "\"*.csv\""),
                new("skills", "skill", Kind::Texts, "[\"pour.skill\"]"),
                new(
                    "replay",
                    "replay",
                    Kind::OneOrMoreTexts,
                    "\"recordings/unseen.csv\"",
                ),
                new("refine", "refine", Kind::Switch, "true").or(false),
                new("play", "play", Kind::Text, "\"wave\""),
                new("console", "console", Kind::Text, "\"127.0.0.1:8723\""),
                new(
                    "frames",
                    "frame",
                    Kind::NumbersByName,
                    "{ goal = [0.3, 0.1, 2.0] }",
                ),
                new("correct", "correct", Kind::Text, "\"recordings/hand.csv\""),
                new("hand_sigma_m", "hand-sigma", Kind::Number, "0.02").or(session.hand_sigma_m),
                new("bound_m", "bound", Kind::Number, "0.005"),
                new("turn_bound_rad", "turn-bound", Kind::Number, "0.02"),
                new("scale", "scale", Kind::Number, "0.1"),
                new(
                    "axes",
                    "axes",
                    Kind::Choice(&["kinect", "base"]),
                    "\"kinect\"",
                ),
                new("gain", "gain", Kind::Number, "1.0").or(session.gain),
                new("future_bound", "future-bound", Kind::Text, "\"0.2way\"").or("0.2way"),
                new("path_bound_m", "path-bound", Kind::Number, "0.01"),
                new(
                    "path_turn_bound_rad",
                    "path-turn-bound",
                    Kind::Number,
                    "0.05",
                )
                .or(session.path_turn_bound_rad),
                new("max_silence_s", "max-silence", Kind::Number, "0.2").or(session.max_silence_s),
                new("min_interval_s", "min-interval", Kind::Number, "0.01")
                    .or(session.min_interval_s),
                new("lease_s", "lease", Kind::Number, "0.65").or(session.lease_s),
                new("rest_s", "rest", Kind::Number, "1.0").or(REST_S),
                new("patience_s", "patience", Kind::Number, "10.0").or(PATIENCE_S),
                new("protocol_max", "protocol-max", Kind::Integer, "1").or(1),
                new("record", "record", Kind::Text, "\"session.mcap\""),
                new("seed", "seed", Kind::Integer, "0").or(0),
                new("input.source", "input", Kind::Text, "\"udp:5005\""),
                new("input.from", "input-from", Kind::Text, "\"192.168.1.7\""),
                new("input.joint", "joint", Kind::Text, "\"right_hand\"").or("right_hand"),
                new(
                    "input.unit",
                    "unit",
                    Kind::Choice(&["m", "cm", "mm"]),
                    "\"m\"",
                ),
                new(
                    "input.time_unit",
                    "time-unit",
                    Kind::Choice(&["s", "ms", "us", "ns"]),
                    "\"s\"",
                )
                .or("s"),
                new("input.grip_range", "grip-range", Kind::Text, "\"0,1\"").or("0,1"),
                new(
                    "input.camera",
                    "camera",
                    Kind::Text,
                    "\"571.2,571.2,320,240\"",
                ),
                new("input.mirror", "mirror", Kind::Switch, "true").or(false),
                new("input.frame_size", "frame-size", Kind::Text, "\"640x480\""),
                new("input.fps", "fps", Kind::Number, "30.0").or(FPS),
                new("input.stick_speed_m_s", "stick-speed", Kind::Number, "0.25").or(SPEED_M_S),
                new("input.engage", "engage", Kind::Switch, "true").or(false),
                new("input.until_end", "until-end", Kind::Switch, "true").or(false),
                new("input.latency_ms", "input-latency", Kind::Number, "60.0").or(0.0),
                new("input.glitch_gate", "glitch-gate", Kind::Switch, "true").or(false),
                new("metrics", "metrics", Kind::Text, "\"127.0.0.1:9434\""),
                new("foxglove", "foxglove", Kind::Text, "\"127.0.0.1:8766\""),
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
        let bound = file
            .future_bound
            .as_deref()
            .map(parse_future_bound)
            .transpose();
        let bound = bound.map_err(anyhow::Error::msg)?;
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
        let tasks = [
            ("replay", file.replay.is_some()),
            ("play", file.play.is_some()),
            ("console", file.console.is_some()),
            ("[input] source", file.input.source.is_some()),
        ];
        let mut named = tasks.iter().filter(|(_, named)| *named);
        if let (Some((one, _)), Some((other, _))) = (named.next(), named.next()) {
            anyhow::bail!("{one} and {other} are two tasks: an operator has one");
        }
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
            self.input_latency = Some(latency.map_err(anyhow::Error::msg)?);
        }
        self.glitch_gate |= file.input.glitch_gate.unwrap_or(false);
        let other = self.play.is_some() || self.console.is_some() || !self.replay.is_empty();
        self.input.over(file.input, !other)?;
        if self.frame.is_empty() && self.play.is_some() {
            self.frame = file
                .frames
                .iter()
                .map(|(name, numbers)| Placed::new(name, numbers))
                .collect::<Result<_, _>>()?;
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
        self.path_turn_bound = self.path_turn_bound.or(file.path_turn_bound_rad);
        self.max_silence = self.max_silence.or(file.max_silence_s);
        self.min_interval = self.min_interval.or(file.min_interval_s);
        self.lease = self.lease.or(file.lease_s);
        self.rest = self.rest.or(file.rest_s);
        self.patience = self.patience.or(file.patience_s);
        self.protocol_max = self.protocol_max.or(file.protocol_max);
        self.record = self.record.or(file.record);
        self.seed = self.seed.or(file.seed);
        self.metrics = self.metrics.or(file.metrics);
        self.foxglove = self.foxglove.or(file.foxglove);
        self.log_format = self.log_format.or(file.log_format);
        Ok(self)
    }

    fn judge(&self) -> anyhow::Result<()> {
        self.session()?;
        self.input.judge()?;
        self.peer
            .as_deref()
            .map(str::parse::<Fingerprint>)
            .transpose()?;
        if !self.replay.is_empty() && self.play.is_some() {
            anyhow::bail!("replay and play: one of them, or console; leave the other out");
        }
        if self.console.is_some() && (!self.replay.is_empty() || self.play.is_some()) {
            anyhow::bail!("console, and a task that needs nobody: leave one out");
        }
        Ok(())
    }

    fn rehearse(&self) -> anyhow::Result<()> {
        self.foxglove
            .map_or(Ok(()), |_| recording::live::is_built())?;
        let named = self.learn.iter().chain(&self.skill).chain(&self.replay);
        for path in named.chain(&self.correct).chain(self.input.path()) {
            std::fs::metadata(path).with_context(|| path.display().to_string())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::FutureBound;

    #[test]
    fn flags_override_what_lies_below() {
        let below = "connect = \"robot:4433\"\nscale = 0.2\nfuture_bound = \"40mm\"\n";
        let args = Args {
            scale: Some(0.1),
            ..Args::default()
        };
        let settled = args.over(below.parse().unwrap()).unwrap();
        assert_eq!(
            (settled.connect.as_deref(), settled.scale),
            (Some("robot:4433"), Some(0.1))
        );
        assert_eq!(
            settled.session().unwrap().future_bound,
            FutureBound::Absolute(0.04)
        );
        let unknown = "conect = \"robot:4433\"\n".parse().unwrap();
        let error = Args::default().over(unknown).unwrap_err().to_string();
        assert!(error.contains("conect"), "{error}");
    }

    #[test]
    fn the_printed_configuration_is_understood_and_complete() {
        // The document has it as it is printed (a test of the whole compares them).
        let lines = telemime_endpoint::config::example::<Args>();
        let lines = lines.lines().filter_map(|line| line.strip_prefix('#'));
        let settings: Vec<_> = lines.filter(|line| !line.starts_with(' ')).collect();
        let file: File = toml::from_str(&settings.join("\n")).unwrap();
        assert!(!file.frames.is_empty(), "[frames] is missing");
        assert!(!format!("{file:?}").contains("None"), "a key is missing");
        parse_future_bound(&file.future_bound.unwrap()).unwrap();
    }

    #[test]
    fn a_default_that_is_written_down_is_what_nothing_gives() {
        let nothing = format!("{:?}", Args::default().session().unwrap());
        for setting in Args::sheet().settings {
            let Some(default) = setting.default else {
                continue;
            };
            let table = match setting.key.split_once('.') {
                Some((of, key)) => format!("[{of}]\n{key} = {default}"),
                None => format!("{} = {default}", setting.key),
            };
            let args = Args::default().over(table.parse().unwrap()).unwrap();
            let session = format!("{:?}", args.session().unwrap());
            assert_eq!(session, nothing, "{}", setting.key);
        }
    }
}
