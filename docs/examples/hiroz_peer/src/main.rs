//! A node of hiroz, a ROS 2 stack in Rust with CDR and type hashes of its own, beside `swarm gateway ros2`:
//! hears what a vehicle of the swarm does, is a vehicle itself, and asks for a plan.
//! Usage: hiroz_peer ROUTER VEHICLE ROBOT TARGET

use std::{env, future::Future, time::Duration};

use hiroz::{
    context::ZContextBuilder,
    qos::{QosDurability, QosHistory, QosProfile},
    Builder, Result,
};
use hiroz_msgs::{
    geometry_msgs::{PoseArray, PoseStamped},
    nav_msgs::{srv::GetPlan, GetPlanRequest, OccupancyGrid, Odometry, Path},
};
use tokio::time::{sleep, timeout};

/// What comes within twenty seconds is printed, or that nothing does.
async fn hear<M, F: Future<Output = Result<M>>>(topic: &str, heard: F, told: impl Fn(&M) -> String) -> Result<()> {
    match timeout(Duration::from_secs(20), heard).await {
        Ok(message) => println!("HEARD {topic} {}", told(&message?)),
        Err(_) => println!("MISSED {topic}"),
    }
    Ok(())
}

#[tokio::main]
async fn main() -> Result<()> {
    let args: Vec<String> = env::args().collect();
    let [_, router, vehicle, robot, target] = &args[..] else { panic!("usage: hiroz_peer ROUTER VEHICLE ROBOT TARGET") };
    let context = ZContextBuilder::default()
        .with_mode("client".to_string())
        .with_connect_endpoints([router.as_str()])
        .build()?;
    let node = context.create_node("hiroz_peer").build()?;
    let latched = QosProfile {
        durability: QosDurability::TransientLocal,
        history: QosHistory::from_depth(1),
        ..Default::default()
    };
    let map = node.create_sub::<OccupancyGrid>("/map").with_qos(latched).build()?;
    let odom = node.create_sub::<Odometry>(&format!("/{vehicle}/odom")).build()?;
    let plan = node.create_sub::<Path>(&format!("/{vehicle}/plan")).build()?;
    let poses = node.create_sub::<PoseArray>("/swarm/poses").build()?;
    println!("READY");
    hear("/map", map.async_recv(), |m| format!("{} x {}", m.info.width, m.info.height)).await?;
    hear("/odom", odom.async_recv(), |m| format!("{} {}", m.header.frame_id, m.child_frame_id)).await?;
    hear("/swarm/poses", poses.async_recv(), |m| format!("{} poses", m.poses.len())).await?;
    hear("/plan", plan.async_recv(), |m| format!("{} poses", m.poses.len())).await?;

    let place = node.create_pub::<PoseStamped>(&format!("/{robot}/pose")).build()?;
    let ask = node.create_client::<GetPlan>(&format!("/{robot}/get_plan")).build()?;
    let mut here = PoseStamped::default();
    here.header.frame_id = "map".to_string();
    here.pose.position.x = 1500.0;
    here.pose.position.y = 1500.0;
    here.pose.orientation.w = 1.0;
    let mut goal = PoseStamped::default();
    goal.header.frame_id = format!("targets/{target}");
    goal.pose.orientation.w = 1.0;
    let mut asked = false;
    for step in 0..150 {
        place.async_publish(&here).await?;
        sleep(Duration::from_millis(100)).await;
        if step >= 50 && !asked {
            let question = GetPlanRequest { start: here.clone(), goal: goal.clone(), tolerance: 0.0 };
            if let Ok(answer) = ask.call_with_timeout(&question, Duration::from_secs(8)).await {
                println!("PLAN {} poses", answer.plan.poses.len());
            }
            asked = true;
        }
    }
    Ok(())
}
