//! A daemon's settings: flags over environment over a TOML file over defaults.
//!
//! Each daemon has one [`Sheet`], a list of what can be set. The example, the schema, the names of the environment's
//! variables and the check are made from it, and its words are those of the command line's help: there is no second
//! list that could differ.

mod check;
mod layers;
mod render;

use std::fmt;
use std::path::{Path, PathBuf};

pub use check::{CheckArgs, check};
pub use layers::{Layers, Origin, environment};
pub use render::{example, schema};

use crate::cli::one_line;

/// What a setting's value looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A string.
    Text,
    /// One of these strings.
    Choice(&'static [&'static str]),
    /// Strings.
    Texts,
    /// A string, or several.
    OneOrMoreTexts,
    /// A number.
    Number,
    /// A whole number, not negative.
    Integer,
    /// `true` or `false`.
    Switch,
    /// Numbers.
    Numbers,
    /// Four numbers.
    Four,
    /// Several times four numbers.
    Fours,
    /// Names with a number each.
    NumberByName,
    /// Names with numbers each.
    NumbersByName,
}

/// One thing that can be set.
#[derive(Debug, Clone)]
pub struct Setting {
    /// Its key in the file, with a dot where it is in a table.
    pub key: &'static str,
    /// Its flag on the command line, without the dashes, if it has one.
    pub flag: Option<&'static str>,
    /// What its value looks like.
    pub kind: Kind,
    /// What it is if nothing is said, as TOML; `None` where that is found out and no constant.
    pub default: Option<String>,
    /// A value that makes sense, as TOML.
    pub example: &'static str,
    /// What it is, where it has no flag whose help says so.
    pub about: &'static str,
}

impl Setting {
    /// A setting that has a flag, and the flag's help.
    pub const fn new(
        key: &'static str,
        flag: &'static str,
        kind: Kind,
        example: &'static str,
    ) -> Self {
        Self {
            key,
            flag: Some(flag),
            kind,
            default: None,
            example,
            about: "",
        }
    }

    /// A setting of the file and the environment alone.
    pub const fn without_flag(
        key: &'static str,
        kind: Kind,
        example: &'static str,
        about: &'static str,
    ) -> Self {
        Self {
            key,
            flag: None,
            kind,
            default: None,
            example,
            about,
        }
    }

    /// The same with what it is if nothing is said.
    #[must_use]
    pub fn or(mut self, default: impl Into<toml::Value>) -> Self {
        self.default = Some(default.into().to_string());
        self
    }
}

/// All that can be set of a daemon.
#[derive(Debug, Clone)]
pub struct Sheet {
    /// The daemon: `robot` or `operator`.
    pub daemon: &'static str,
    /// In the order of the example.
    pub settings: Vec<Setting>,
    /// Keys of which a layer's replace all those of the layers below.
    pub alternatives: &'static [&'static [&'static str]],
}

impl Sheet {
    /// The setting of a key.
    pub fn get(&self, key: &str) -> Option<&Setting> {
        self.settings.iter().find(|setting| setting.key == key)
    }

    /// What the variables of the environment begin with.
    pub fn prefix(&self) -> String {
        format!("TELEMIME_{}_", self.daemon.to_uppercase())
    }

    /// The environment's variable of a setting.
    pub fn variable(&self, setting: &Setting) -> String {
        let key = setting.key.replace('.', "_").to_uppercase();
        self.prefix() + &key
    }

    /// Keys that are no settings themselves but tables of them.
    fn is_table_of_settings(&self, key: &str) -> bool {
        self.settings
            .iter()
            .any(|setting| setting.key.split_once('.').is_some_and(|(t, _)| t == key))
    }

    /// The key that was probably meant.
    fn nearest(&self, key: &str) -> Option<&'static str> {
        let near = |setting: &Setting| (strsim::jaro_winkler(setting.key, key), setting.key);
        let best = self.settings.iter().map(near);
        let best = best.max_by(|a, b| a.0.total_cmp(&b.0));
        best.filter(|(near, _)| *near > 0.8).map(|(_, key)| key)
    }
}

/// A daemon's flags, which know what lies below them.
pub trait Settings: clap::Args + Clone + Default + fmt::Debug {
    /// All that can be set.
    fn sheet() -> Sheet;

    /// These flags over the settings of a table.
    ///
    /// # Errors
    /// A key that is none, or a value that cannot be read.
    fn over(self, below: toml::Table) -> anyhow::Result<Self>;

    /// What cannot be, found without touching anything.
    ///
    /// # Errors
    /// One line that says what to do.
    fn judge(&self) -> anyhow::Result<()>;

    /// What only shows once the files are read that the settings name.
    ///
    /// # Errors
    /// One line that says what to do.
    fn rehearse(&self) -> anyhow::Result<()>;

    /// These flags over what the environment sets, over what `file` does, judged.
    ///
    /// # Errors
    /// All that cannot be.
    fn settled(&self, file: Option<&Path>) -> Result<Self, Unusable> {
        let below = Layers::read::<Self>(file, &environment()).table()?;
        let settled = self.clone().over(below);
        let judged = settled.and_then(|settled| settled.judge().map(|()| settled));
        judged.map_err(|e| Unusable::Judged(one_line(e.chain())))
    }
}

/// A daemon will not begin with what it was set to: its exit code is 2.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Unusable {
    /// File or environment.
    #[error(transparent)]
    Read(#[from] ConfigError),
    /// Values that cannot be, or not together.
    #[error("{0}")]
    Judged(String),
}

/// Where something wrong stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// On a line of the file, from 1.
    Line(PathBuf, usize),
    /// In the file as a whole.
    File(PathBuf),
    /// In a variable of the environment.
    Variable(String),
    /// In what was set altogether.
    Whole,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(path, line) => write!(f, "{}:{line}", path.display()),
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Variable(name) => f.write_str(name),
            Self::Whole => f.write_str("altogether"),
        }
    }
}

/// Something wrong with the settings.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {text}")]
pub struct Problem {
    /// Where.
    pub place: Place,
    /// What, and what to do.
    pub text: String,
}

/// The settings cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct ConfigError {
    /// All that is wrong; at least one.
    pub problems: Vec<Problem>,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, problem) in self.problems.iter().enumerate() {
            let gap = if i > 0 { "; " } else { "" };
            write!(f, "{gap}{problem}")?;
        }
        Ok(())
    }
}
