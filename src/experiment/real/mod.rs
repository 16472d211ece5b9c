//! Grounds in real time: the daemons as processes, the link a relay between real sockets or the kernel's own.

mod daemons;
mod netns;
mod outcome;

use telemime_operator::cli::Axes;
use telemime_operator::skill_file::SkillFileError;
use telemime_sim::link::LinkConfig;

use super::factor::Settings;
use super::subject::Subject;
use super::trace::Trace;

/// Where ours runs. Baselines are computed, whatever the ground.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Default,
    clap::ValueEnum,
    serde::Serialize,
    serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub(super) enum Ground {
    /// One thread, a paused clock, an in-memory network: the same bytes every time.
    #[default]
    Virtual,
    /// Two processes in real time, the relay of `telemime link` between them.
    Loopback,
    /// Two processes in two network namespaces, the kernel's netem between them; needs root.
    Netns,
}

impl Ground {
    /// The word for it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Virtual => "virtual",
            Self::Loopback => "loopback",
            Self::Netns => "netns",
        }
    }

    /// Whether a run's link can be made here.
    pub(super) fn fits(self, settings: &Settings) -> Result<(), netns::NetnsError> {
        match self {
            Self::Virtual | Self::Loopback => Ok(()),
            Self::Netns => netns::fits(settings),
        }
    }

    /// Whether this host has what it takes for runs of these settings.
    pub(super) fn missing<'a>(
        self,
        mut runs: impl Iterator<Item = &'a Settings>,
    ) -> Result<(), Missing> {
        let wire = LinkConfig::default();
        match self {
            Self::Virtual | Self::Loopback => Ok(()),
            Self::Netns => netns::missing(runs.any(|s| s.up != wire || s.down != wire)),
        }
    }
}

impl std::fmt::Display for Ground {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// What a host lacks for a ground.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the ground netns needs {0}; --ground loopback needs nothing, and virtual is the fastest")]
pub(crate) struct Missing(pub(super) String);

impl Missing {
    /// The exit code that says so.
    pub(crate) const EXIT: u8 = 3;
}

/// Why a run in real time gave no result.
#[derive(Debug, thiserror::Error)]
pub(super) enum RealError {
    #[error("no temporary folder, or nothing can be written there: {0}")]
    Scratch(#[from] std::io::Error),
    #[error(transparent)]
    Skill(#[from] SkillFileError),
    #[error("{0:#}")]
    Daemons(#[from] anyhow::Error),
    #[error("{0}")]
    Netns(#[from] netns::NetnsError),
}

/// Drives the arm through one recording by both daemons; the link's chances follow from `seed`.
pub(super) fn drive(
    ground: Ground,
    settings: &Settings,
    subject: &Subject,
    axes: Axes,
    seed: u64,
) -> Result<Trace, RealError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let scratch = tempfile::tempdir()?;
    let driven = daemons::Driven {
        settings,
        subject,
        axes,
        seed,
        scratch: scratch.path(),
    };
    let left = match ground {
        Ground::Netns => {
            let spaces = netns::Namespaces::new(settings)?;
            runtime.block_on(driven.by_kernel(&spaces))?
        }
        Ground::Virtual | Ground::Loopback => runtime.block_on(driven.by_relay())?,
    };
    Ok(outcome::trace(settings, subject, left)?)
}
