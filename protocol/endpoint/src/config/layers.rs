//! The layers below the flags, each value with where it comes from.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use super::{ConfigError, Place, Problem, Settings, Sheet};

/// Where a value comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// The file's line, from 1.
    File(usize),
    /// This variable of the environment.
    Variable(String),
}

/// What the file and the environment set.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Layers {
    /// By key.
    pub values: BTreeMap<String, (Value, Origin)>,
    /// What is wrong with the rest.
    pub problems: Vec<Problem>,
}

/// The process's environment, as far as it is text.
pub fn environment() -> Vec<(String, String)> {
    std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
        .collect()
}

impl Layers {
    /// Reads `file`, if there is one, and the variables among `environment` that are the daemon's.
    pub fn read<D: Settings>(file: Option<&Path>, environment: &[(String, String)]) -> Self {
        let sheet = D::sheet();
        let mut layers = Self::default();
        if let Some(path) = file {
            match std::fs::read_to_string(path) {
                Ok(text) => layers.take_file::<D>(&sheet, path, &text),
                Err(e) => layers.wrong(
                    Place::File(path.to_owned()),
                    format!("cannot be read: {e}; `--print-config` prints one to begin with"),
                ),
            }
        }
        layers.take_environment::<D>(&sheet, environment);
        layers
    }

    /// As a table of settings.
    ///
    /// # Errors
    /// [`ConfigError`], if anything is wrong.
    pub fn table(&self) -> Result<Table, ConfigError> {
        if !self.problems.is_empty() {
            let problems = self.problems.clone();
            return Err(ConfigError { problems });
        }
        Ok(nested(
            self.values.iter().map(|(key, (value, _))| (key, value)),
        ))
    }

    fn wrong(&mut self, place: Place, text: String) {
        self.problems.push(Problem { place, text });
    }

    fn take_file<D: Settings>(&mut self, sheet: &Sheet, path: &Path, text: &str) {
        let line = |at: usize| text[..at.min(text.len())].matches('\n').count() + 1;
        let place = |at: usize| Place::Line(path.to_owned(), line(at));
        let root = match DeTable::parse(text) {
            Ok(root) => root,
            Err(e) => {
                let at = e.span().map_or(0, |span| span.start);
                let what = e.message().replace('\n', ": ");
                return self.wrong(place(at), format!("this is no TOML: {what}"));
            }
        };
        for (key, at, value) in keys(sheet, root.get_ref()) {
            let Some(setting) = sheet.get(&key) else {
                let meant = match sheet.nearest(&key) {
                    Some(near) => format!("did you mean `{near}`?"),
                    None => "`--print-config` lists those there are".to_owned(),
                };
                self.wrong(place(at), format!("there is no key `{key}`; {meant}"));
                continue;
            };
            // A value that has been parsed is one.
            let Ok(value) = Value::deserialize(toml::de::ValueDeserializer::from(value.clone()))
            else {
                self.wrong(place(at), format!("`{key}` cannot be read"));
                continue;
            };
            match understood::<D>(setting.key, &value) {
                Ok(()) => {
                    let origin = Origin::File(line(at));
                    self.values.insert(key, (value, origin));
                }
                Err(why) => self.wrong(place(at), format!("`{key} = {value}`: {why}")),
            }
        }
    }

    fn take_environment<D: Settings>(&mut self, sheet: &Sheet, environment: &[(String, String)]) {
        let prefix = sheet.prefix();
        let mut found = BTreeMap::new();
        for (name, text) in environment {
            let Some(rest) = name.strip_prefix(&prefix) else {
                continue;
            };
            let named = |s: &&super::Setting| sheet.variable(s) == *name;
            let Some(setting) = sheet.settings.iter().find(named) else {
                let meant = sheet.nearest(&rest.to_lowercase());
                let meant = meant.and_then(|key| sheet.get(key));
                let meant = meant.map_or_else(
                    || "unset it; `--print-config` lists the keys there are".to_owned(),
                    |near| format!("did you mean {}?", sheet.variable(near)),
                );
                self.wrong(
                    Place::Variable(name.clone()),
                    format!("there is no such setting; {meant}"),
                );
                continue;
            };
            match typed::<D>(setting.key, text) {
                Ok(value) => drop(found.insert(setting.key, (value, name.clone()))),
                Err(why) => self.wrong(Place::Variable(name.clone()), format!("`{text}`: {why}")),
            }
        }
        for key in found.keys() {
            let group = sheet.alternatives.iter().find(|group| group.contains(key));
            for other in group.into_iter().flat_map(|group| group.iter()) {
                self.values.remove(*other);
            }
        }
        for (key, (value, name)) in found {
            let origin = Origin::Variable(name);
            self.values.insert(key.to_owned(), (value, origin));
        }
    }
}

/// The keys of a file, those of tables of settings with a dot, where each stands, and its value.
fn keys<'t, 'i>(
    sheet: &Sheet,
    root: &'t DeTable<'i>,
) -> Vec<(String, usize, &'t Spanned<DeValue<'i>>)> {
    let mut found = Vec::new();
    for (key, value) in root {
        let name = key.get_ref().as_ref();
        match value.get_ref() {
            DeValue::Table(inner) if sheet.is_table_of_settings(name) => {
                let inner = inner.iter();
                found.extend(inner.map(|(k, v)| {
                    let name = format!("{name}.{}", k.get_ref());
                    (name, k.span().start, v)
                }));
            }
            _ => found.push((name.to_owned(), key.span().start, value)),
        }
    }
    found.sort_by_key(|(_, at, _)| *at);
    found
}

/// A table of settings by key.
pub(super) fn nested<'v>(values: impl Iterator<Item = (&'v String, &'v Value)>) -> Table {
    let mut table = Table::new();
    for (key, value) in values {
        match key.split_once('.') {
            Some((outer, inner)) => {
                let below = table
                    .entry(outer)
                    .or_insert_with(|| Value::Table(Table::new()));
                if let Value::Table(below) = below {
                    below.insert(inner.to_owned(), value.clone());
                }
            }
            None => drop(table.insert(key.clone(), value.clone())),
        }
    }
    table
}

/// Whether the daemon can read this value of this key.
fn understood<D: Settings>(key: &str, value: &Value) -> Result<(), String> {
    let table = nested(std::iter::once((&key.to_owned(), value)));
    let read = D::default().over(table);
    let wrong = |e: anyhow::Error| crate::cli::one_line(e.chain()).trim().to_owned();
    read.map(drop).map_err(wrong)
}

/// A variable's text as the value that the setting takes: TOML if that is what it takes, else the text itself, else
/// the texts between its commas.
fn typed<D: Settings>(key: &str, text: &str) -> Result<Value, String> {
    let as_toml = format!("v = {text}").parse::<Table>().ok();
    let as_toml = as_toml.and_then(|mut table| table.remove("v").filter(|_| table.is_empty()));
    let parts = text.split(',').map(|part| Value::from(part.trim()));
    let tries = [
        as_toml,
        Some(Value::from(text)),
        Some(Value::Array(parts.collect())),
    ];
    let mut why = None;
    for value in tries.into_iter().flatten() {
        match understood::<D>(key, &value) {
            Ok(()) => return Ok(value),
            Err(e) => why = why.or(Some(e)),
        }
    }
    Err(why.unwrap_or_default())
}
