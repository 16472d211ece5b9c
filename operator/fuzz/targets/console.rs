//! What a page says: any text is refused for a reason, or is a command whose numbers and names are what they may be.

#![no_main]

use libfuzzer_sys::fuzz_target;
use telemime_operator::console::command::{Command, MAX_COMMAND_LEN, MAX_HAND_M, MAX_NAME};

fn named(name: &str) {
    assert!((1..=MAX_NAME).contains(&name.chars().count()));
    assert!(!name.starts_with('.') && !name.contains(['/', '\\', '\0', '\n']));
}

fuzz_target!(|text: &str| {
    let Ok(command) = Command::parse(text) else {
        return;
    };
    assert!(text.len() <= MAX_COMMAND_LEN);
    match command {
        Command::Hold { skill, t, x, .. } => {
            skill.as_deref().map_or((), named);
            assert!(t.is_finite() && x.iter().all(|v| v.abs() <= MAX_HAND_M));
        }
        Command::Hand { t, x } => assert!(t.is_finite() && x.iter().all(|v| v.abs() <= MAX_HAND_M)),
        Command::Predict { gain } => assert!((0.0..=1.0).contains(&gain)),
        Command::Learn { name } | Command::Use { skill: name } => named(&name),
        Command::Link(shape) => {
            assert!((0.0..=2000.0).contains(&shape.delay_ms));
            assert!((0.0..=1000.0).contains(&shape.jitter_ms));
            assert!((0.0..=100.0).contains(&shape.loss_percent));
        }
        Command::Alive {}
        | Command::Release {}
        | Command::Stop {}
        | Command::Reset {}
        | Command::Discard {} => {}
    }
});
