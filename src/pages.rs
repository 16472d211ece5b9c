//! Man pages and shell completions, out of the command lines themselves.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Command;
use clap_complete::Shell;
use telemime_endpoint::cli::say;

/// Print what a shell needs to complete our commands.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    shell: Shell,
    /// Of which program.
    #[arg(long, value_name = "NAME", default_value = "telemime", value_parser = ["telemime", "telemime-robot", "telemime-operator"])]
    program: String,
}

/// Write man pages: telemime.1, one for each of its commands, telemime-robot.1 and telemime-operator.1.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct ManArgs {
    /// The folder to write to, made if it is not there; what is there is overwritten.
    dir: PathBuf,
}

/// A page and those of the commands below it, without `skip`, whose pages are whole programs'.
fn write(command: &Command, name: &str, dir: &Path, skip: &[&str]) -> anyhow::Result<usize> {
    let file = dir.join(format!("{name}.1"));
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone()).render(&mut page)?;
    std::fs::write(&file, page).with_context(|| format!("cannot write {}", file.display()))?;
    let mut written = 1;
    for below in command.get_subcommands() {
        let path = format!("{name}-{}", below.get_name());
        if below.is_hide_set() || below.get_name() == "help" || skip.contains(&path.as_str()) {
            continue;
        }
        let title: &'static str = Box::leak(path.clone().into_boxed_str());
        written += write(&below.clone().name(title), &path, dir, skip)?;
    }
    Ok(written)
}

/// Writes man pages.
///
/// # Errors
/// A folder that cannot be written.
pub(crate) fn man(args: &ManArgs) -> anyhow::Result<()> {
    let dir = &args.dir;
    std::fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
    let robot = telemime_robot::program::command();
    let operator = telemime_operator::program::command();
    let whole = ["telemime-robot", "telemime-operator"];
    let mut written = 0;
    for (name, mut command) in [
        ("telemime", crate::cli::command()),
        ("telemime-robot", robot),
        ("telemime-operator", operator),
    ] {
        command.build();
        written += write(&command, name, dir, &whole)?;
    }
    say(&format!("{written} pages in {}", dir.display()))
}

/// Prints completions.
///
/// # Errors
/// Stdout's.
pub(crate) fn completions(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut command = match args.program.as_str() {
        "telemime-robot" => telemime_robot::program::command(),
        "telemime-operator" => telemime_operator::program::command(),
        _ => crate::cli::command(),
    };
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, &args.program, &mut script);
    say(String::from_utf8(script)?.trim_end())
}
