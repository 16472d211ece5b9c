//! The command line.

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use telemime_endpoint::admin;
use telemime_endpoint::cli::one_line;
use telemime_endpoint::config::{self, CheckArgs};
use telemime_endpoint::peers::Role;
use telemime_sim::link::{
    LinkConfig, Loss, Rate, parse_duration_s, parse_probability, parse_rate_bit_s,
};

use crate::{
    arm, codec, demo, doctor, evaluate, experiment, ingest, link, pages, paper, recognise, replay,
    select, send, tap, teach,
};

/// Teleoperation that learns the operator's skills, so that the robot moves with the hand and not a
/// network delay behind it.
///
/// Without a command it runs the demo: two daemons, a bad link between them, and what is left of the delay.
#[derive(Parser)]
#[command(version, name = "telemime", args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    demo: demo::Args,
}

#[expect(clippy::large_enum_variant, reason = "there is one, parsed once")]
#[derive(Subcommand)]
enum Command {
    /// Both daemons as two processes over a shaped link, and what became of the delay.
    Demo(Box<demo::Args>),
    /// Make demonstrations of raw recordings: skeletons, tables of a hand's path, or depth frames.
    Import(Box<ingest::Args>),
    /// Learn a skill from a folder of demonstrations and save it.
    Learn(teach::LearnArgs),
    /// Show what a saved skill holds.
    Inspect(teach::InspectArgs),
    /// List the skills there are.
    List(recognise::ListArgs),
    /// Say which skill a recording shows, moment by moment, or that it is none of them.
    Recognise(recognise::RecogniseArgs),
    /// Try recognition on demonstrations held out: which skills are confused, what is refused.
    Confusion(recognise::ConfusionArgs),
    /// Compare mixtures for a folder of demonstrations: kinds, numbers of components, criteria.
    Select(select::Args),
    /// How well motion is predicted: every recording by skills that were learned without it.
    Evaluate(evaluate::Args),
    /// Compress recordings within an error bound, ours beside other ways.
    Codec(codec::Args),
    /// The operator daemon: teach, drive, play.
    Operator(Box<telemime_operator::cli::Args>),
    /// The robot daemon: an arm that follows.
    Robot(telemime_robot::cli::Args),
    /// Run a robot's black box again, and tell what happened.
    Replay(replay::Args),
    /// Send a recording at true speed, as a tracker would.
    Send(send::Args),
    Arm(arm::Args),
    Identity(admin::IdentityArgs),
    Pair(telemime_operator::cli::PairArgs),
    Peers(admin::PeersArgs),
    CheckConfig(CheckConfigArgs),
    /// Look at this host, and the way to a robot: what is in order, what is not, and what to do.
    Doctor(doctor::Args),
    /// Print what a shell needs to complete our commands.
    Completions(pages::CompletionsArgs),
    /// Write man pages.
    Man(pages::ManArgs),
    /// Measure the input's latency from taps on a table.
    Tap(tap::Args),
    /// A plan's runs: both daemons on a virtual clock, and what they are held against.
    Experiment(Box<experiment::Args>),
    /// The results of an experiment as one HTML page.
    Report(experiment::report::Args),
    /// A UDP relay that delays, loses and throttles what passes.
    Link(Box<link::Args>),
    /// Reproduce the tables of the source publication beside ours.
    Paper(paper::Args),
}

#[derive(clap::Args, Debug, Clone)]
struct CheckConfigArgs {
    /// Whose configuration it is.
    #[arg(value_enum)]
    daemon: admin::End,
    #[command(flatten)]
    check: CheckArgs,
}

impl CheckConfigArgs {
    fn run(&self) -> anyhow::Result<bool> {
        let environment = config::environment();
        match self.daemon {
            admin::End::Operator => {
                config::check::<telemime_operator::cli::Args>(&self.check, &environment)
            }
            admin::End::Robot => {
                config::check::<telemime_robot::cli::Args>(&self.check, &environment)
            }
        }
    }
}

/// `1 run`, `2 runs`.
pub(crate) fn plural(n: usize, one: &str, many: &str) -> String {
    format!("{n} {}", if n == 1 { one } else { many })
}

/// The whole command line, for man pages and completions.
pub(crate) fn command() -> clap::Command {
    Cli::command()
}

/// What a link does to packets, in either direction.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Shape {
    /// Delay one way.
    #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = parse_duration_s)]
    pub(crate) delay: f64,
    /// Uniform spread around the delay; it reorders.
    #[arg(long, value_name = "TIME", default_value = "10ms", value_parser = parse_duration_s)]
    pub(crate) jitter: f64,
    /// Share of packets lost.
    #[arg(long, value_name = "P", default_value = "1%", value_parser = parse_probability)]
    pub(crate) loss: f64,
    /// Bottleneck [default: unlimited].
    #[arg(long, value_name = "RATE", value_parser = parse_rate_bit_s)]
    pub(crate) rate: Option<u64>,
    /// Seed of the link's chances.
    #[arg(long, default_value_t = 1)]
    pub(crate) link_seed: u64,
}

impl Shape {
    pub(crate) fn config(&self) -> LinkConfig {
        LinkConfig {
            delay_s: self.delay,
            jitter_s: self.jitter,
            loss: Loss::random(self.loss),
            rate: self.rate.map(Rate::bits),
            ..LinkConfig::default()
        }
    }
}

/// What a link does to packets, in each direction.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Ways {
    #[command(flatten)]
    pub(crate) shape: Shape,
    /// From the operator to the robot, in netem's words, instead of --delay, --jitter, --loss and --rate:
    /// "delay 100ms 10ms distribution normal loss gemodel 1% 10% outage 5s..7s".
    #[arg(long, value_name = "LINK")]
    up: Option<LinkConfig>,
    /// From the robot to the operator, likewise.
    #[arg(long, value_name = "LINK")]
    down: Option<LinkConfig>,
}

impl Ways {
    /// From the operator to the robot.
    pub(crate) fn up(&self) -> LinkConfig {
        self.up.clone().unwrap_or_else(|| self.shape.config())
    }

    /// From the robot to the operator.
    pub(crate) fn down(&self) -> LinkConfig {
        self.down.clone().unwrap_or_else(|| self.shape.config())
    }

    /// In words.
    pub(crate) fn describe(&self) -> String {
        if self.up.is_some() || self.down.is_some() {
            return format!("up: {}; down: {}", self.up(), self.down());
        }
        format!(
            "{:.0} ± {:.0} ms and {:.1} % loss each way",
            self.shape.delay * 1e3,
            self.shape.jitter * 1e3,
            self.shape.loss * 1e2
        )
    }
}

/// Parses the command line and runs it; the exit code is 0, 1 (failed, with one line on stderr) or 2 (usage, or a
/// configuration that cannot be).
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match &cli.command {
        Some(Command::CheckConfig(args)) => match args.run() {
            Ok(true) => Ok(()),
            Ok(false) => return ExitCode::from(2),
            Err(e) => Err(e),
        },
        Some(Command::Doctor(args)) => match doctor::run(args) {
            Ok(true) => Ok(()),
            Ok(false) => return ExitCode::FAILURE,
            Err(e) => Err(e),
        },
        Some(Command::Completions(args)) => pages::completions(args),
        Some(Command::Man(args)) => pages::man(args),
        None => demo::run(&cli.demo),
        Some(Command::Demo(args)) => demo::run(args),
        Some(Command::Import(args)) => ingest::run(args),
        Some(Command::Learn(args)) => teach::learn(args),
        Some(Command::Inspect(args)) => teach::inspect(args),
        Some(Command::List(args)) => recognise::list(args),
        Some(Command::Recognise(args)) => recognise::recognise(args),
        Some(Command::Confusion(args)) => recognise::confusion(args),
        Some(Command::Select(args)) => select::run(args),
        Some(Command::Evaluate(args)) => evaluate::run(args),
        Some(Command::Codec(args)) => codec::run(args),
        Some(Command::Tap(args)) => tap::run(args),
        Some(Command::Operator(args)) => telemime_operator::cli::run(args),
        Some(Command::Robot(args)) => telemime_robot::cli::run(args),
        Some(Command::Replay(args)) => replay::run(args),
        Some(Command::Send(args)) => send::run(args),
        Some(Command::Arm(args)) => arm::run(args),
        Some(Command::Identity(args)) => admin::identity(args, Role::Operator),
        Some(Command::Pair(args)) => telemime_operator::cli::pair(args),
        Some(Command::Peers(args)) => admin::peers(args),
        Some(Command::Link(args)) => link::run(args),
        Some(Command::Experiment(args)) => experiment::run(args),
        Some(Command::Report(args)) => experiment::report::run(args),
        Some(Command::Paper(args)) => paper::run(args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) if e.is::<demo::CutShort>() => ExitCode::FAILURE,
        Err(e) => {
            eprintln!("telemime: {}", one_line(e.chain()));
            match e.downcast_ref::<experiment::Missing>() {
                Some(_) => ExitCode::from(experiment::Missing::EXIT),
                None => telemime_endpoint::cli::failure(&e),
            }
        }
    }
}
