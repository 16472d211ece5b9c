//! Who may come in.

use super::super::guard::{Guard, Pass, Refused, Request, Token};

fn asks<'a>(host: &'a str, origin: Option<&'a str>) -> Request<'a> {
    Request {
        host: Some(host),
        origin,
        ..Request::default()
    }
}

#[test]
fn on_loopback_the_host_must_be_ours_and_the_origin_too() {
    let guard = Guard::new(([127, 0, 0, 1], 8723).into(), None);
    for host in ["127.0.0.1:8723", "localhost:8723", "[::1]:8723"] {
        let origin = format!("http://{host}");
        assert_eq!(guard.judge(&asks(host, None)), Ok(Pass::Known), "{host}");
        assert_eq!(guard.judge(&asks(host, Some(&origin))), Ok(Pass::Known));
    }
    // A name that was made to point here, another port, no name at all.
    for host in [
        "evil.example:8723",
        "localhost:80",
        "localhost",
        "192.0.2.1:8723",
        "",
    ] {
        let refused = guard.judge(&asks(host, None));
        assert_eq!(refused, Err(Refused::Host(host.into())), "{host}");
    }
    assert!(guard.judge(&Request::default()).is_err());
    for origin in [
        "http://evil.example",
        "null",
        "https://127.0.0.1:8723",
        "http://localhost:8723",
        "http://127.0.0.1",
    ] {
        let refused = guard.judge(&asks("127.0.0.1:8723", Some(origin)));
        assert_eq!(refused, Err(Refused::Origin(origin.into())), "{origin}");
    }
}

#[test]
fn beyond_loopback_the_token_is_asked_for() {
    let token = Token::new([7; 16]);
    let guard = Guard::new(([0, 0, 0, 0], 8723).into(), Some(token.clone()));
    let plain = asks("192.0.2.7:8723", None);
    assert_eq!(guard.judge(&plain), Err(Refused::Token));
    // Names can be made to point anywhere: with the token too.
    let named = Request {
        query: Some("token=07070707070707070707070707070707"),
        ..asks("robot.example:8723", None)
    };
    assert!(matches!(guard.judge(&named), Err(Refused::Host(_))));
    let with = |query, cookies| {
        guard.judge(&Request {
            query,
            cookies,
            ..plain
        })
    };
    let given = format!("token={}", token.text());
    assert_eq!(with(Some(&given), None), Ok(Pass::Token));
    let among = format!("a=b&{given}");
    assert_eq!(with(Some(&among), None), Ok(Pass::Token));
    for wrong in ["token=", "token=07", &given[..given.len() - 1], &given[6..]] {
        assert_eq!(with(Some(wrong), None), Err(Refused::Token), "{wrong}");
    }
    let cookie = guard.cookie().unwrap();
    let cookies = format!("x=y; {cookie}");
    assert_eq!(with(None, Some(&cookies)), Ok(Pass::Known));
    assert_eq!(
        with(None, Some("telemime-8723=; telemime-1=x")),
        Err(Refused::Token)
    );
    // Whoever prints it does not print it.
    assert_eq!(format!("{token:?}"), "Token(…)");
}
