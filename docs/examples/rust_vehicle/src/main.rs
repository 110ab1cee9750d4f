//! A vehicle in Rust: says where it is, in JSON, and asks for the route to target t0.
use serde_json::{json, Value};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use zenoh::bytes::Encoding;

#[tokio::main]
async fn main() -> zenoh::Result<()> {
    let mut config = zenoh::Config::default();
    let router = std::env::args().nth(1).unwrap_or("tcp/127.0.0.1:7447".into());
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &json!([router]).to_string())?;
    let session = zenoh::open(config).await?;

    let asked = session.get("swarm/target/t0/route?row=40;col=60;format=json").await?;
    let reply = asked.recv_async().await?.into_result().expect("a route");
    let route: Value = serde_json::from_slice(&reply.payload().to_bytes())?;
    println!("{} s to t0", route["routes"][0]["cost_s"]);

    let started = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
    for seq in 1..=50 {
        let body = json!({"key": "body/rusty", "incarnation": started, "seq": seq, "x_m": 1805.0, "y_m": -1215.0, "radius_m": 5.0});
        session.put("swarm/body/rusty", body.to_string()).encoding(Encoding::APPLICATION_JSON).await?;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    Ok(())
}
