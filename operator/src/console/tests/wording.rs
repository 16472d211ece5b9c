//! What a page may say.

use super::super::{BadCommand, Command, Holding, Shape};

#[test]
fn what_the_page_says_is_understood() {
    let hold = r#"{"do":"hold","what":"hand","t":12.5,"x":[0.5,0,0.25]}"#;
    assert_eq!(
        Command::parse(hold),
        Ok(Command::Hold {
            what: Holding::Hand,
            skill: None,
            t: 12.5,
            x: [0.5, 0.0, 0.25]
        })
    );
    for (text, command) in [
        (r#"{"do":"stop"}"#, Command::Stop {}),
        (
            r#"{"do":"reset","changes":7}"#,
            Command::Reset { changes: 7 },
        ),
        (
            r#"{"do":"predict","gain":0.5}"#,
            Command::Predict { gain: 0.5 },
        ),
        (
            r#"{"do":"learn","name":"ein Bogen"}"#,
            Command::Learn {
                name: "ein Bogen".into(),
            },
        ),
        (
            r#"{"do":"link","delay_ms":100,"jitter_ms":0,"loss_percent":0.5}"#,
            Command::Link(Shape {
                delay_ms: 100.0,
                jitter_ms: 0.0,
                loss_percent: 0.5,
            }),
        ),
    ] {
        assert_eq!(Command::parse(text), Ok(command), "{text}");
    }
}

#[test]
fn what_is_no_command_is_refused_and_says_why() {
    for (text, why) in [
        ("", "not a command"),
        ("{}", "not a command"),
        ("[]", "not a command"),
        (r#"{"do":"dance"}"#, "dance"),
        (r#"{"do":"stop","now":true}"#, "now"),
        (r#"{"do":"reset"}"#, "changes"),
        (r#"{"do":"hand","t":0,"x":[0,0]}"#, "not a command"),
        (r#"{"do":"hand","t":0,"x":[0,0,1e999]}"#, "not a command"),
        (r#"{"do":"hand","t":0,"x":[0,0,NaN]}"#, "not a command"),
        (r#"{"do":"hand","t":0,"x":[0,0,6]}"#, "x is 6"),
        (r#"{"do":"hand","t":-1,"x":[0,0,0]}"#, "t is -1"),
        (r#"{"do":"predict","gain":1.5}"#, "gain is 1.5"),
        (r#"{"do":"learn","name":""}"#, "name"),
        (r#"{"do":"learn","name":"../skill"}"#, "name"),
        (r#"{"do":"learn","name":"a\nb"}"#, "name"),
        (r#"{"do":"use","skill":".hidden"}"#, "name"),
        (
            r#"{"do":"link","delay_ms":1e9,"jitter_ms":0,"loss_percent":0}"#,
            "delay_ms",
        ),
        (r#"{"do":"hold","what":"fly","t":0,"x":[0,0,0]}"#, "fly"),
    ] {
        let refused = Command::parse(text).unwrap_err().to_string();
        assert!(refused.contains(why), "{text}: {refused}");
    }
    let long = format!(r#"{{"do":"learn","name":"{}"}}"#, "n".repeat(2000));
    let len = long.len();
    assert_eq!(Command::parse(&long), Err(BadCommand::TooLong { len }));
}
