//! What can be set, as an example to edit and as a JSON Schema.

use std::fmt::Write;

use clap::Command;
use serde_json::{Map, Value, json};

use super::{Kind, Setting, Settings, Sheet};

/// Columns of the example.
const WIDTH: usize = 100;

/// What a setting is: the help of its flag, in one line.
pub(super) fn about(command: &Command, setting: &Setting) -> String {
    let flag = setting.flag.and_then(|flag| {
        command
            .get_arguments()
            .find(|arg| arg.get_long() == Some(flag))
    });
    let help = flag.and_then(|arg| arg.get_long_help().or(arg.get_help()));
    let text = help.map_or_else(|| setting.about.to_owned(), ToString::to_string);
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The daemon's flags, for their help.
pub(super) fn command<D: Settings>() -> Command {
    D::augment_args(Command::new(D::sheet().daemon))
}

fn comment(out: &mut String, text: &str) {
    let mut line = String::new();
    for word in text.split(' ') {
        if !line.is_empty() && line.chars().count() + word.chars().count() + 3 > WIDTH {
            let _ = writeln!(out, "# {line}");
            line.clear();
        }
        if !line.is_empty() {
            line.push(' ');
        }
        line.push_str(word);
    }
    let _ = writeln!(out, "# {line}");
}

/// A file to begin with: everything that can be set, commented out, with its default where it has one.
pub fn example<D: Settings>() -> String {
    let (sheet, command) = (D::sheet(), command::<D>());
    let daemon = sheet.daemon;
    let mut out = String::new();
    let first = &sheet.settings[0];
    comment(
        &mut out,
        &format!(
            "Settings of the Telemime {daemon}: telemime {daemon} --config {daemon}.toml. Every key may be left out: take away \
             the # before one to set it. It shows the default, or an example where the default is not a constant. A \
             variable of the environment ({} for {}, with _ for the dot of a table) comes before this file, a flag before \
             both; telemime check-config {daemon} FILE --explain says what comes from where.",
            sheet.variable(first),
            first.key
        ),
    );
    let mut table = "";
    let (within, outside): (Vec<_>, Vec<_>) =
        sheet.settings.iter().partition(|s| s.key.contains('.'));
    for setting in outside.into_iter().chain(within) {
        let (of, key) = setting.key.split_once('.').unwrap_or(("", setting.key));
        out.push('\n');
        if of != table {
            let _ = writeln!(out, "#[{of}]");
            table = of;
        }
        comment(&mut out, &about(&command, setting));
        let value = setting.default.as_deref().unwrap_or(setting.example);
        let _ = writeln!(out, "#{key} = {value}");
    }
    out
}

fn shape(kind: Kind) -> Value {
    let numbers = || json!({ "type": "array", "items": { "type": "number" } });
    let texts = || json!({ "type": "array", "items": { "type": "string" } });
    let four =
        || json!({ "type": "array", "items": { "type": "number" }, "minItems": 4, "maxItems": 4 });
    match kind {
        Kind::Text => json!({ "type": "string" }),
        Kind::Choice(words) => json!({ "enum": words }),
        Kind::Texts => texts(),
        Kind::OneOrMoreTexts => json!({ "anyOf": [{ "type": "string" }, texts()] }),
        Kind::Number => json!({ "type": "number" }),
        Kind::Integer => json!({ "type": "integer", "minimum": 0 }),
        Kind::Switch => json!({ "type": "boolean" }),
        Kind::Numbers => numbers(),
        Kind::Four => four(),
        Kind::Fours => json!({ "type": "array", "items": four() }),
        Kind::NumberByName => {
            json!({ "type": "object", "additionalProperties": { "type": "number" } })
        }
        Kind::NumbersByName => json!({ "type": "object", "additionalProperties": numbers() }),
    }
}

fn described(command: &Command, setting: &Setting) -> Value {
    let mut shape = shape(setting.kind);
    if let Value::Object(shape) = &mut shape {
        shape.insert("description".into(), about(command, setting).into());
        let value = |text: &str| {
            let table = format!("v = {text}").parse::<toml::Table>().ok();
            table.and_then(|table| serde_json::to_value(&table["v"]).ok())
        };
        if let Some(default) = setting.default.as_deref().and_then(value) {
            shape.insert("default".into(), default);
        }
        if let Some(example) = value(setting.example) {
            shape.insert("examples".into(), Value::Array(vec![example]));
        }
    }
    shape
}

/// The JSON Schema (draft 2020-12) of the daemon's file, for editors that complete and check TOML by it.
pub fn schema<D: Settings>() -> Value {
    let (sheet, command) = (D::sheet(), command::<D>());
    let Sheet {
        daemon, settings, ..
    } = &sheet;
    let mut properties = Map::new();
    for setting in settings {
        let described = described(&command, setting);
        match setting.key.split_once('.') {
            None => drop(properties.insert(setting.key.into(), described)),
            Some((of, key)) => {
                let table = properties.entry(of).or_insert_with(
                    || json!({ "type": "object", "properties": {}, "additionalProperties": false }),
                );
                table["properties"][key] = described;
            }
        }
    }
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": format!("Settings of the Telemime {daemon}"),
        "type": "object",
        "properties": properties,
        "additionalProperties": false,
    })
}
